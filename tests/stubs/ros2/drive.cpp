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
  ++warnings;
  std::vfprintf(stderr, format, arguments);
  va_end(arguments);
}
}  // namespace rclcpp

namespace {
constexpr int N = ARM_JOINTS;
using arm_controller::msg::Target;
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
    if (controller.update(rclcpp::Time(), rclcpp::Duration(0.001)) != controller_interface::return_type::OK) return -1;
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
  auto &parameters = arm_controller::set_params;
  parameters.effort_states = true;
  parameters.frame = "base";
  const auto refused = [&] { return controller.on_configure({}) == controller_interface::CallbackReturn::ERROR; };
  parameters.joints = {"A1", "A2"};
  std::printf("two joints refused %d\n", refused());
  parameters.joints = {"A7", "A2", "A3", "A4", "A5", "A6", "A1"};  // in any order: they are those of arm.h
  parameters.command = "position";
  std::printf("torques as positions refused %d\n", refused());
  parameters.command = "";
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

  auto target = std::make_shared<Target>();
  arm_reference reference;
  const double start = first_extra();
  target->header.frame_id = "base";
  target->header.stamp = controller.get_node()->now();
  target->names = {"xi1"};
  target->values = {start + 0.1};
  const auto send = [](const Target &message) {
    const int before = rclcpp::warnings;
    made<rclcpp::Subscription<Target>>->callback(std::make_shared<Target>(message));
    return rclcpp::warnings == before;  // accepted
  };
  std::printf("target %d\n", send(*target));
  std::printf("moved %d\n", run(controller, 4000));
  std::printf("moved by %.6f\n", first_extra() - start);

  // Refused: NaN, an unknown or doubled name, too few values, another frame, an old stamp.
  const auto spoil = [&](auto change) {
    Target other = *target;
    other.values[0] = start;
    change(other);
    return !send(other);
  };
  std::printf("NaN refused %d\n", spoil([](Target &other) { other.values[0] = std::nan(""); }));
  std::printf("unknown name refused %d\n", spoil([](Target &other) { other.names[0] = "xi9"; }));
  std::printf("double name refused %d\n", spoil([](Target &other) { other.names = {"xi1", "xi1"}, other.values = {0, 0}; }));
  std::printf("too few refused %d\n", spoil([](Target &other) { other.names.clear(); }));
  std::printf("other frame refused %d\n", spoil([](Target &other) { other.header.frame_id = "camera"; }));
  controller.get_node()->clock += 0.6;
  std::printf("old target refused %d\n", spoil([](Target &) {}));
  parameters.target_age = 0.0;
  parameters.__stamp = rclcpp::Time(1.0);
  std::printf("spoiled targets %d\n", run(controller, 500));
  std::printf("still moved by %.6f\n", first_extra() - start);
  // Its age does not matter any more; two messages between two ticks, each with a name of its own.
  target->values = {start + 0.05};
  std::printf("old target now %d\n", send(*target));
  arm_reference_at(q.data(), &reference);
  target->names = {"z"};
  target->values = {reference.value[2] + 0.01};
  std::printf("two names %d\n", send(*target));
  const double height = reference.value[2];
  std::printf("moved again %d\n", run(controller, 4000));
  std::printf("now moved by %.6f\n", first_extra() - start);
  arm_reference_at(q.data(), &reference);
  std::printf("risen by %.6f\n", reference.value[2] - height);

  std::printf("blind %d\n", run(controller, 50, true));
  std::printf("seeing again %d\n", run(controller, 500));
  const auto &diagnosed = made<rclcpp::Publisher<diagnostic_msgs::msg::DiagnosticArray>>->last.status.front();
  std::printf("level %d\n", diagnosed.level);
  std::printf("diagnosis: %s 0\n", diagnosed.message.c_str());
  if (controller.on_deactivate({}) != controller_interface::CallbackReturn::SUCCESS) return 1;
  std::printf("refused without a controller %d\n", !resume());
  std::printf("target without a controller refused %d\n", !send(*target));
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
  const Target &present = made<rclcpp::Publisher<Target>>->last;
  std::printf("present off by %.6f\n", std::fabs(present.values[ARM_TASK] - reference.value[ARM_TASK]));
  std::printf("present %s %s 0\n", present.header.frame_id.c_str(), present.names[ARM_TASK].c_str());
  return 0;
}
