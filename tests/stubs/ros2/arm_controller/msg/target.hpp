// What rosidl makes of examples/ros2_control/msg/Target.msg.
#pragma once
#include <memory>
#include <string>
#include <vector>

#include "std_msgs/msg/header.hpp"
namespace arm_controller::msg {
struct Target {
  using SharedPtr = std::shared_ptr<Target>;
  std_msgs::msg::Header header;
  std::vector<std::string> names;
  std::vector<double> values;
};
}  // namespace arm_controller::msg
