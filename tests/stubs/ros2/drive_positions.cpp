// Runs the controller of examples/ros2_control with a law of velocities on drives that take positions, with a lag of 20 ms.
// They stand still for a second, as after a protective stop. Prints what a test checks.
#include <array>
#include <cmath>
#include <cstdio>

#include "arm_controller/arm_controller.hpp"

namespace rclcpp {
void log_with_format(const Logger &, const char *, ...) { ++warnings; }
}  // namespace rclcpp

int main() {
  constexpr int N = ARM_JOINTS;
  using arm_controller::msg::Target;
  using rclcpp_lifecycle::made;
  arm_controller::ArmController controller;
  std::array<double, N> q, dq{}, command{};
  std::vector<hardware_interface::LoanedCommandInterface> commands;
  std::vector<hardware_interface::LoanedStateInterface> states;
  for (int i = 0; i < N; ++i) {
    q[i] = 0.5 * (arm_domain_lower[i] + arm_domain_upper[i]);
    commands.emplace_back(&command[i]);
    states.emplace_back(&q[i]);
    states.emplace_back(&dq[i]);
  }
  arm_controller::set_params.command = "position";
  if (controller.on_init() != controller_interface::CallbackReturn::SUCCESS) return 1;
  if (controller.on_configure({}) != controller_interface::CallbackReturn::SUCCESS) return 1;
  std::printf("command %s\n", controller.command_interface_configuration().names.front().c_str());
  controller.assign_interfaces(std::move(commands), std::move(states));
  if (controller.on_activate({}) != controller_interface::CallbackReturn::SUCCESS) return 1;

  double lead = 0.0, jump = 0.0;
  const auto run = [&](int ticks, bool blocked) {
    for (int tick = 0; tick < ticks; ++tick) {
      const std::array<double, N> before = command;
      controller.update(rclcpp::Time(), rclcpp::Duration(0.001));
      for (int i = 0; i < N; ++i) {
        lead = std::fmax(lead, std::fabs(command[i] - q[i]) / arm_default_safety.speed_limit[i]);
        if (before[i] != 0.0) jump = std::fmax(jump, std::fabs(command[i] - before[i]));
        dq[i] = blocked ? 0.0 : 50.0 * (command[i] - q[i]);
        q[i] += 0.001 * dq[i];
      }
    }
    made<rclcpp::TimerBase>->callback();
  };
  arm_reference reference;
  arm_reference_at(q.data(), &reference);
  const double start = reference.value[ARM_TASK];
  Target target;
  target.names = {"xi1"};
  target.values = {start + 0.1};
  run(100, false);
  made<rclcpp::Subscription<Target>>->callback(std::make_shared<Target>(target));
  run(300, false);
  run(1000, true);
  run(500, false);
  const auto &status = made<rclcpp::Publisher<std_msgs::msg::UInt8>>->last;
  std::printf("blocked %d\n", status.data);
  auto response = std::make_shared<std_srvs::srv::Trigger::Response>();
  made<rclcpp::Service<std_srvs::srv::Trigger>>->callback(std::make_shared<std_srvs::srv::Trigger::Request>(), response);
  run(1000, false);
  made<rclcpp::Subscription<Target>>->callback(std::make_shared<Target>(target));
  run(6000, false);
  arm_reference_at(q.data(), &reference);
  std::printf("moved by %.5f\n", reference.value[ARM_TASK] - start);
  std::printf("led by %.3f\n", lead);
  std::printf("jump %.5f\n", jump);
  std::printf("status %d\n", status.data);
  return 0;
}
