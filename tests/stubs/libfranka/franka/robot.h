// The part of libfranka 0.15.0 that docs/how-to/robots.md uses, with the same signatures. Nothing works.
#pragma once
#include <array>
#include <functional>
#include <initializer_list>
#include <string>

namespace franka {
struct Finishable {
  bool motion_finished = false;
};
class Torques : public Finishable {
 public:
  Torques(const std::array<double, 7> &torques) noexcept;
  Torques(std::initializer_list<double> torques);
};
inline Torques MotionFinished(Torques command) noexcept { return command; }
class Duration {};
struct RobotState {
  std::array<double, 7> tau_J_d{}, tau_ext_hat_filtered{}, q{}, dq{};
};
constexpr double kDefaultCutoffFrequency = 100.0;
enum class RealtimeConfig { kEnforce, kIgnore };

class Robot {
 public:
  explicit Robot(const std::string &franka_address, RealtimeConfig realtime_config = RealtimeConfig::kEnforce,
                 size_t log_size = 50);
  virtual ~Robot() noexcept;
  void control(std::function<Torques(const RobotState &, franka::Duration)> control_callback, bool limit_rate = false,
               double cutoff_frequency = kDefaultCutoffFrequency);
  virtual RobotState readOnce();
  void setLoad(double load_mass, const std::array<double, 3> &F_x_Cload, const std::array<double, 9> &load_inertia);
};
}  // namespace franka
