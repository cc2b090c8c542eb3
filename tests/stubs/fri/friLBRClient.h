// The part of KUKA's FRI 1.15 that docs/how-to/robots.md uses, with the same signatures. Nothing works.
#pragma once

namespace KUKA {
namespace FRI {
enum ESessionState { IDLE = 0, MONITORING_WAIT = 1, MONITORING_READY = 2, COMMANDING_WAIT = 3, COMMANDING_ACTIVE = 4 };
class LBRState {
 public:
  double getSampleTime() const;
  const double *getMeasuredJointPosition() const;
  const double *getExternalTorque() const;
};
class LBRCommand {
 public:
  void setJointPosition(const double *values);
  void setTorque(const double *torques);
};
class IClient {
 public:
  virtual ~IClient() {}
};
class LBRClient : public IClient {
 public:
  LBRClient();
  ~LBRClient();
  virtual void onStateChange(ESessionState oldState, ESessionState newState);
  virtual void monitor();
  virtual void waitForCommand();
  virtual void command();
  const LBRState &robotState() const;
  LBRCommand &robotCommand();
};
}  // namespace FRI
}  // namespace KUKA
