// Runs the controller of examples/ros2_control on the stand-ins of this folder, around forward dynamics with the model of
// the library. The law leaves gravity to the robot. Prints what a test checks.
#include <array>
#include <cmath>
#include <cstdarg>
#include <cstdio>
#include <limits>

#include "arm_controller/arm_controller.hpp"

namespace rclcpp {
void log_with_format(const Logger &, const char *format, ...) {
  va_list arguments;
  va_start(arguments, format);
  std::vfprintf(stderr, format, arguments);
  va_end(arguments);
}
}  // namespace rclcpp

namespace {
constexpr int N = ARM_JOINTS;
using rclcpp_lifecycle::made;
std::array<double, N> q, dq, seen, torque, felt;

// One semi-implicit Euler step of M ddq + C dq = torque.
void move_arm() {
  double M[N * N], bias[N], gravity[N], ddq[N];
  arm_dynamics(q.data(), dq.data(), M, bias, gravity);
  for (int i = 0; i < N; ++i) ddq[i] = torque[i] - bias[i] + gravity[i];
  for (int k = 0; k < N; ++k)
    for (int i = k + 1; i < N; ++i) {
      const double factor = M[i * N + k] / M[k * N + k];
      for (int j = k; j < N; ++j) M[i * N + j] -= factor * M[k * N + j];
      ddq[i] -= factor * ddq[k];
    }
  for (int i = N - 1; i >= 0; --i) {
    for (int j = i + 1; j < N; ++j) ddq[i] -= M[i * N + j] * ddq[j];
    ddq[i] /= M[i * N + i];
  }
  for (int i = 0; i < N; ++i) {
    dq[i] += 0.001 * ddq[i];
    q[i] += 0.001 * dq[i];
  }
}

int run(arm_controller::ArmController &controller, int ticks, bool blind = false) {
  for (int tick = 0; tick < ticks; ++tick) {
    seen = q;
    if (blind) seen[2] = std::numeric_limits<double>::quiet_NaN();
    if (controller.update({}, rclcpp::Duration(0.001)) != controller_interface::return_type::OK) return -1;
    move_arm();
  }
  made<rclcpp::TimerBase>->callback();
  return made<rclcpp::Publisher<std_msgs::msg::UInt8>>->last.data;
}

double first_extra() {
  arm_reference reference;
  arm_reference_at(q.data(), &reference);
  return reference.value[ARM_TASK];
}
}  // namespace

int main() {
  arm_controller::ArmController controller;
  std::vector<hardware_interface::LoanedCommandInterface> commands;
  std::vector<hardware_interface::LoanedStateInterface> states;
  for (int i = 0; i < N; ++i) {
    q[i] = 0.5 * (arm_domain_lower[i] + arm_domain_upper[i]);
    commands.emplace_back(&torque[i]);
    states.emplace_back(&seen[i]);
    states.emplace_back(&dq[i]);
    states.emplace_back(&felt[i]);
  }
  seen = q;
  if (controller.on_init() != controller_interface::CallbackReturn::SUCCESS) return 1;
  controller.get_node()->parameters["smoothness"].number = 3.0;
  controller.get_node()->parameters["effort_states"].number = 1.0;
  controller.get_node()->parameters["joints"] = {};
  std::printf("without joints %d\n", controller.on_configure({}) == controller_interface::CallbackReturn::ERROR);
  controller.get_node()->parameters["joints"].names = {"A1", "A2", "A3", "A4", "A5", "A6", "A7"};
  if (controller.on_configure({}) != controller_interface::CallbackReturn::SUCCESS) return 1;
  std::printf("first command %s\n", controller.command_interface_configuration().names.front().c_str());
  std::printf("last state %s\n", controller.state_interface_configuration().names.back().c_str());
  controller.assign_interfaces(std::move(commands), std::move(states));
  for (const double wrong : {100.0, std::numeric_limits<double>::quiet_NaN()}) {
    felt[1] = wrong;
    std::printf("held by %.0f %d\n", wrong, controller.on_activate({}) == controller_interface::CallbackReturn::ERROR);
  }
  felt[1] = 0.0;
  if (controller.on_activate({}) != controller_interface::CallbackReturn::SUCCESS) return 1;
  std::printf("held %d\n", run(controller, 500));
  const auto resume = [] {
    auto response = std::make_shared<std_srvs::srv::Trigger::Response>();
    made<rclcpp::Service<std_srvs::srv::Trigger>>->callback(std::make_shared<std_srvs::srv::Trigger::Request>(), response);
    return response->success;
  };
  std::printf("nothing to resume %d\n", !resume());

  auto target = std::make_shared<std_msgs::msg::Float64MultiArray>();
  arm_reference reference;
  arm_reference_at(q.data(), &reference);
  target->data.assign(reference.value, reference.value + ARM_REFERENCE);
  const double start = first_extra();
  target->data[ARM_TASK] += 0.1;
  made<rclcpp::Subscription<std_msgs::msg::Float64MultiArray>>->callback(target);
  std::printf("moved %d\n", run(controller, 4000));
  std::printf("moved by %.6f\n", first_extra() - start);

  auto spoiled = std::make_shared<std_msgs::msg::Float64MultiArray>(*target);
  spoiled->data[ARM_TASK] = std::numeric_limits<double>::quiet_NaN();
  made<rclcpp::Subscription<std_msgs::msg::Float64MultiArray>>->callback(spoiled);
  std::printf("spoiled target %d\n", run(controller, 500));
  std::printf("still moved by %.6f\n", first_extra() - start);
  target->data[ARM_TASK] -= 0.05;
  made<rclcpp::Subscription<std_msgs::msg::Float64MultiArray>>->callback(target);
  std::printf("moved again %d\n", run(controller, 4000));
  std::printf("now moved by %.6f\n", first_extra() - start);

  std::printf("blind %d\n", run(controller, 50, true));
  std::printf("seeing again %d\n", run(controller, 500));
  if (controller.on_deactivate({}) != controller_interface::CallbackReturn::SUCCESS) return 1;
  std::printf("refused without a controller %d\n", !resume());
  if (controller.on_activate({}) != controller_interface::CallbackReturn::SUCCESS) return 1;
  std::printf("held again %d\n", run(controller, 500));
  std::printf("blind again %d\n", run(controller, 50, true));
  std::printf("seeing once more %d\n", run(controller, 500));
  std::printf("accepted %d\n", resume());
  std::printf("resumed %d\n", run(controller, 3000));
  auto closed = std::make_shared<std_srvs::srv::SetBool::Request>();
  auto answer = std::make_shared<std_srvs::srv::SetBool::Response>();
  closed->data = true;
  made<rclcpp::Service<std_srvs::srv::SetBool>>->callback(closed, answer);
  std::printf("brakes closed %d\n", run(controller, 100));
  std::printf("refused under brakes %d\n", !resume());
  closed->data = false;
  made<rclcpp::Service<std_srvs::srv::SetBool>>->callback(closed, answer);
  std::printf("brakes open %d\n", run(controller, 100));
  arm_reference_at(q.data(), &reference);
  const auto &present = made<rclcpp::Publisher<std_msgs::msg::Float64MultiArray>>->last.data;
  std::printf("present off by %.6f\n", std::fabs(present[ARM_TASK] - reference.value[ARM_TASK]));
  return 0;
}
