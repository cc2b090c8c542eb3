#pragma once
#include <friLBRClient.h>
#include <friUdpConnection.h>
namespace KUKA {
namespace FRI {
class ClientApplication {
 public:
  ClientApplication(IConnection &connection, IClient &client);
  bool connect(int port, const char *remoteHost = nullptr);
  void disconnect();
  bool step();
};
}  // namespace FRI
}  // namespace KUKA
