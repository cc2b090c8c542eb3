#pragma once
namespace KUKA {
namespace FRI {
class IConnection {
 public:
  virtual ~IConnection() {}
};
class UdpConnection : public IConnection {
 public:
  UdpConnection(unsigned int receiveTimeout = 0);
  ~UdpConnection();
};
}  // namespace FRI
}  // namespace KUKA
