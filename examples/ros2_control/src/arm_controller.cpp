#include "arm_controller/arm_controller.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <exception>
#include <limits>
#include <memory>

#include "hardware_interface/types/hardware_interface_type_values.hpp"
#include "pluginlib/class_list_macros.hpp"

namespace arm_controller {

using controller_interface::CallbackReturn;
using controller_interface::InterfaceConfiguration;
using controller_interface::interface_configuration_type;
using controller_interface::return_type;

namespace {
constexpr const char *COMMAND =
    ARM_COMMANDS_TORQUE ? hardware_interface::HW_IF_EFFORT : hardware_interface::HW_IF_VELOCITY;
}  // namespace

CallbackReturn ArmController::on_init() {
  try {
    auto_declare<std::vector<std::string>>("joints", {});
    auto_declare<double>("smoothness", 3.0);
    auto_declare<bool>("effort_states", false);
  } catch (const std::exception &error) {
    RCLCPP_ERROR(get_node()->get_logger(), "cannot declare parameters: %s", error.what());
    return CallbackReturn::ERROR;
  }
  return CallbackReturn::SUCCESS;
}

InterfaceConfiguration ArmController::command_interface_configuration() const {
  InterfaceConfiguration wanted{interface_configuration_type::INDIVIDUAL, {}};
  for (const auto &joint : joints_) wanted.names.push_back(joint + "/" + COMMAND);
  return wanted;
}

InterfaceConfiguration ArmController::state_interface_configuration() const {
  InterfaceConfiguration wanted{interface_configuration_type::INDIVIDUAL, {}};
  for (const auto &joint : joints_) {
    wanted.names.push_back(joint + "/" + hardware_interface::HW_IF_POSITION);
    wanted.names.push_back(joint + "/" + hardware_interface::HW_IF_VELOCITY);
    if (effort_states_) wanted.names.push_back(joint + "/" + hardware_interface::HW_IF_EFFORT);
  }
  return wanted;
}

CallbackReturn ArmController::on_configure(const rclcpp_lifecycle::State & /*previous*/) {
  joints_ = get_node()->get_parameter("joints").as_string_array();
  smoothness_ = get_node()->get_parameter("smoothness").as_double();
  effort_states_ = get_node()->get_parameter("effort_states").as_bool();
  for (auto &position : present_) position = std::numeric_limits<double>::quiet_NaN();
  if (joints_.size() != ARM_JOINTS || !(smoothness_ > 0.0)) {
    RCLCPP_ERROR(get_node()->get_logger(), "expected %d joints and smoothness > 0, received %zu joints and %g",
                 ARM_JOINTS, joints_.size(), smoothness_.load());
    return CallbackReturn::ERROR;
  }
  target_subscription_ = get_node()->create_subscription<std_msgs::msg::Float64MultiArray>(
      "~/target", rclcpp::SystemDefaultsQoS(), [this](const std_msgs::msg::Float64MultiArray::SharedPtr message) {
        if (message->data.size() != ARM_REFERENCE) {
          RCLCPP_WARN(get_node()->get_logger(), "expected %d values, received %zu", ARM_REFERENCE,
                      message->data.size());
          return;
        }
        if (!std::all_of(message->data.begin(), message->data.end(), [](double value) { return std::isfinite(value); })) {
          RCLCPP_WARN(get_node()->get_logger(), "refused a target with NaN or infinity; the last one stays");
          return;
        }
        Target target;
        target.number = ++received_;
        std::copy(message->data.begin(), message->data.end(), target.value.begin());
        box_.set(target);
      });
  resume_service_ = get_node()->create_service<std_srvs::srv::Trigger>(
      "~/resume", [this](const std::shared_ptr<std_srvs::srv::Trigger::Request> /*request*/,
                         std::shared_ptr<std_srvs::srv::Trigger::Response> response) {
        const int last = status_;
        response->success = active_ && last == ARM_CAUGHT && !brakes_closed_;
        response->message = response->success ? "the arm goes on as soon as it is slow"
                            : !active_        ? "refused: the controller is not active"
                            : brakes_closed_  ? "refused: brakes hold the arm"
                                              : "nothing to resume: the catcher does not hold the arm";
        if (response->success) resume_asked_ = true;
      });
  brakes_service_ = get_node()->create_service<std_srvs::srv::SetBool>(
      "~/brakes", [this](const std::shared_ptr<std_srvs::srv::SetBool::Request> request,
                         std::shared_ptr<std_srvs::srv::SetBool::Response> response) {
        brakes_closed_ = request->data;
        brakes_asked_ = request->data ? 1 : 0;
        response->success = true;
        response->message = active_ ? "in the next tick" : "not active: kept until the controller is";
      });
  present_publisher_ = get_node()->create_publisher<std_msgs::msg::Float64MultiArray>("~/present", rclcpp::SystemDefaultsQoS());
  status_publisher_ = get_node()->create_publisher<std_msgs::msg::UInt8>("~/status", rclcpp::SystemDefaultsQoS());
  status_timer_ = get_node()->create_wall_timer(std::chrono::milliseconds(50), [this]() { publish(); });
  return CallbackReturn::SUCCESS;
}

void ArmController::publish() {
  const double smoothness = get_node()->get_parameter("smoothness").as_double();  // may change at run time
  if (smoothness > 0.0 && std::isfinite(smoothness)) smoothness_ = smoothness;
  std_msgs::msg::UInt8 status;
  std_msgs::msg::Float64MultiArray present;
  arm_reference here;
  double q[ARM_JOINTS];
  std::copy(present_.begin(), present_.end(), q);
  arm_reference_at(q, &here);
  if (std::isfinite(q[0])) present.data.assign(here.value, here.value + ARM_REFERENCE);  // else before the first tick
  status.data = static_cast<std::uint8_t>(status_.load());
  status_publisher_->publish(status);
  present_publisher_->publish(present);
  if (const unsigned lost = lost_.exchange(0)) RCLCPP_WARN(get_node()->get_logger(), "%u commands were not written", lost);
}

CallbackReturn ArmController::on_activate(const rclcpp_lifecycle::State & /*previous*/) {
  double q[ARM_JOINTS], dq[ARM_JOINTS], effort[ARM_JOINTS];
  if (state_interfaces_.size() != (effort_states_ ? 3 : 2) * ARM_JOINTS || command_interfaces_.size() != ARM_JOINTS) {
    RCLCPP_ERROR(get_node()->get_logger(), "the hardware lacks interfaces");
    return CallbackReturn::ERROR;
  }
  read_robot(q, dq, effort);
  if (!std::all_of(q, q + ARM_JOINTS, [](double value) { return std::isfinite(value); })) {
    RCLCPP_ERROR(get_node()->get_logger(), "the hardware reports no joint positions yet");
    return CallbackReturn::ERROR;
  }
  const bool held = brakes_closed_;  // then no effort says what the arm needs
  double mismatch[ARM_JOINTS];
  const arm_status checked =
      effort_states_ && !held ? arm_check_start(&arm_default_safety, q, effort, &arm_default_gains, mismatch) : ARM_OK;
  for (int i = 0; i < ARM_JOINTS && checked == ARM_LOAD_MISMATCH; ++i)
    if (std::fabs(mismatch[i]) > arm_default_safety.start_mismatch[i])
      RCLCPP_ERROR(get_node()->get_logger(), "joint %s is held by %g more than its model says: wrong mounting or tool?",
                   joints_[static_cast<std::size_t>(i)].c_str(), mismatch[i]);
  if (checked != ARM_OK) {
    RCLCPP_ERROR(get_node()->get_logger(), "refused to start: the efforts that hold the arm have status %d", checked);
    return CallbackReturn::ERROR;
  }
  arm_start(&state_, q, ARM_COMMANDS_TORQUE && effort_states_ && !held ? effort : nullptr);
  if (held) arm_hold(&state_, q, nullptr);
  arm_reference_at(q, &reference_);
  std::copy_n(reference_.value, ARM_REFERENCE, target_.value.begin());
  target_.number = received_;  // targets from before the activation are void
  resume_asked_ = false;
  brakes_asked_ = -1;
  status_ = ARM_OK;
  active_ = true;
  return CallbackReturn::SUCCESS;
}

CallbackReturn ArmController::on_deactivate(const rclcpp_lifecycle::State & /*previous*/) {
  active_ = false;
  return CallbackReturn::SUCCESS;  // the hardware decides what an arm without a controller does
}

// Missing values become NaN: the supervised law then holds its last command, and says BAD_INPUT.
void ArmController::read_robot(double *q, double *dq, double *effort) const {
  constexpr double missing = std::numeric_limits<double>::quiet_NaN();
  const std::size_t each = effort_states_ ? 3 : 2;
  for (std::size_t i = 0; i < ARM_JOINTS; ++i) {
    q[i] = state_interfaces_[each * i].get_optional().value_or(missing);
    dq[i] = state_interfaces_[each * i + 1].get_optional().value_or(missing);
    effort[i] = effort_states_ ? state_interfaces_[each * i + 2].get_optional().value_or(missing) : missing;
  }
}

// A stream follows the targets while the law commands. Otherwise, the reference stays where the arm is.
void ArmController::move_reference(const double *q, double period) {
  const int last = status_;
  const auto latest = box_.try_get();
  const bool fresh = latest && latest->number != target_.number;
  if (last == ARM_CAUGHT || last == ARM_RETURNING) {
    arm_reference_at(q, &reference_);
    std::copy_n(reference_.value, ARM_REFERENCE, target_.value.begin());
    if (fresh) target_.number = latest->number;  // void: the arm is not where it was meant to start from
    return;
  }
  if (fresh) target_ = *latest;
  arm_reference_stream(&state_, &reference_, target_.value.data(), smoothness_, period);
}

return_type ArmController::update(const rclcpp::Time & /*time*/, const rclcpp::Duration &period) {
  double q[ARM_JOINTS], dq[ARM_JOINTS], effort[ARM_JOINTS], command[ARM_JOINTS];
  bool written = true;
  read_robot(q, dq, effort);
  const int brakes = brakes_asked_.exchange(-1);
  const double *now = ARM_COMMANDS_TORQUE && effort_states_ ? effort : nullptr;
  if (brakes == 1) arm_hold(&state_, q, now);
  if (brakes == 0) arm_release(&state_, q, now);
  move_reference(q, period.seconds());
  if (resume_asked_.exchange(false)) arm_resume(&state_);
  status_ = arm_step(&state_, &arm_default_safety, q, dq, &reference_, &arm_default_gains, period.seconds(), command);
  for (std::size_t i = 0; i < ARM_JOINTS; ++i) written = command_interfaces_[i].set_value(command[i]) && written;
  if (!written) ++lost_;  // an ERROR would deactivate the controller: the arm would lose all its commands for a single one
  std::copy_n(q, ARM_JOINTS, present_.begin());
  return return_type::OK;
}

}  // namespace arm_controller

PLUGINLIB_EXPORT_CLASS(arm_controller::ArmController, controller_interface::ControllerInterface)
