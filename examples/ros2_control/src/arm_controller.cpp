#include "arm_controller/arm_controller.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <exception>
#include <limits>
#include <memory>
#include <string>

#include "hardware_interface/types/hardware_interface_type_values.hpp"
#include "pluginlib/class_list_macros.hpp"

namespace arm_controller {

using controller_interface::CallbackReturn;
using controller_interface::InterfaceConfiguration;
using controller_interface::interface_configuration_type;
using controller_interface::return_type;

namespace {
const std::array<std::string, ARM_JOINTS> JOINTS = ARM_JOINT_NAMES;
const std::array<std::string, ARM_REFERENCE> QUANTITIES = ARM_REFERENCE_NAMES;
constexpr double NONE = std::numeric_limits<double>::quiet_NaN();
constexpr double LEASH = 0.1;  // [s] at full speed that commanded positions may lead the arm by

// What a status means, to people.
const char *explain(int status) {
  switch (status) {
    case ARM_OK: return "the law commands";
    case ARM_OUTSIDE_DOMAIN: return "outside the domain of the chart";
    case ARM_SINGULAR: return "near a singular position";
    case ARM_NOT_FINITE: return "a result is not finite";
    case ARM_SATURATED: return "the command is cut by its limit";
    case ARM_NEAR_BOUNDARY: return "near the boundary of the domain";
    case ARM_CAUGHT: return "the catcher holds the arm: ~/resume when the cause is gone";
    case ARM_RETURNING: return "the catcher brings the arm back";
    case ARM_BAD_INPUT: return "measurements are missing or wrong";
    default: return "see arm_status in arm.h";
  }
}
}  // namespace

CallbackReturn ArmController::on_init() {
  try {
    listener_ = std::make_shared<ParamListener>(get_node());
  } catch (const std::exception &error) {
    RCLCPP_ERROR(get_node()->get_logger(), "cannot declare parameters: %s", error.what());
    return CallbackReturn::ERROR;
  }
  return CallbackReturn::SUCCESS;
}

InterfaceConfiguration ArmController::command_interface_configuration() const {
  InterfaceConfiguration wanted{interface_configuration_type::INDIVIDUAL, {}};
  for (const auto &joint : joints_) wanted.names.push_back(joint + "/" + command_);
  return wanted;
}

InterfaceConfiguration ArmController::state_interface_configuration() const {
  InterfaceConfiguration wanted{interface_configuration_type::INDIVIDUAL, {}};
  for (const auto &joint : joints_) {
    wanted.names.push_back(joint + "/" + hardware_interface::HW_IF_POSITION);
    wanted.names.push_back(joint + "/" + hardware_interface::HW_IF_VELOCITY);
    if (params_.effort_states) wanted.names.push_back(joint + "/" + hardware_interface::HW_IF_EFFORT);
  }
  return wanted;
}

CallbackReturn ArmController::on_configure(const rclcpp_lifecycle::State & /*previous*/) {
  params_ = listener_->get_params();
  smoothness_ = params_.smoothness;
  for (auto &position : present_) position = NONE;
  // Joints that are those of arm.h have its order, whatever the parameter's; others are in that order already.
  joints_ = params_.joints;
  if (joints_.empty() || std::is_permutation(joints_.begin(), joints_.end(), JOINTS.begin(), JOINTS.end()))
    joints_.assign(JOINTS.begin(), JOINTS.end());
  if (joints_.size() != ARM_JOINTS) {
    RCLCPP_ERROR(get_node()->get_logger(), "expected %d joints, received %zu", ARM_JOINTS, joints_.size());
    return CallbackReturn::ERROR;
  }
  const std::string natural =
      ARM_COMMANDS_TORQUE ? hardware_interface::HW_IF_EFFORT : hardware_interface::HW_IF_VELOCITY;
  command_ = params_.command.empty() ? natural : params_.command;
  if (command_ != natural && (ARM_COMMANDS_TORQUE || command_ != hardware_interface::HW_IF_POSITION)) {
    RCLCPP_ERROR(get_node()->get_logger(), "the law commands %s, received command: %s", natural.c_str(), command_.c_str());
    return CallbackReturn::ERROR;
  }
  const rclcpp::SystemDefaultsQoS qos;
  target_subscription_ = get_node()->create_subscription<msg::Target>(
      "~/target", qos, [this](const msg::Target::SharedPtr message) { receive(*message); });
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
  present_publisher_ = get_node()->create_publisher<msg::Target>("~/present", qos);
  status_publisher_ = get_node()->create_publisher<std_msgs::msg::UInt8>("~/status", qos);
  diagnostics_publisher_ = get_node()->create_publisher<diagnostic_msgs::msg::DiagnosticArray>("/diagnostics", qos);
  status_timer_ = get_node()->create_wall_timer(std::chrono::milliseconds(50), [this]() { publish(); });
  return CallbackReturn::SUCCESS;
}

// Why a target is refused; empty if it is not.
std::string ArmController::refusal(const msg::Target &message) const {
  const auto &names = message.names;
  if (!active_) return "the controller is not active";
  if (message.values.size() != (names.empty() ? ARM_REFERENCE : names.size())) return "names and values differ in number";
  for (const auto &name : names) {
    if (std::find(QUANTITIES.begin(), QUANTITIES.end(), name) == QUANTITIES.end()) return "unknown quantity " + name;
    if (std::count(names.begin(), names.end(), name) > 1) return name + " is there twice";
  }
  if (!std::all_of(message.values.begin(), message.values.end(), [](double value) { return std::isfinite(value); }))
    return "NaN or infinity";
  const auto &frame = message.header.frame_id;
  if (!params_.frame.empty() && !frame.empty() && frame != params_.frame)
    return "frame " + frame + ", expected " + params_.frame;
  const auto &stamp = message.header.stamp;
  if (params_.target_age > 0.0 && (stamp.sec != 0 || stamp.nanosec != 0)) {
    const rclcpp::Time now = get_node()->now();
    const double age = (now - rclcpp::Time(stamp, now.get_clock_type())).seconds();
    if (age > params_.target_age) return "it is " + std::to_string(age) + " s old";
  }
  return "";
}

void ArmController::receive(const msg::Target &message) {
  if (const std::string reason = refusal(message); !reason.empty()) {
    RCLCPP_WARN(get_node()->get_logger(), "refused a target: %s; the last one stays", reason.c_str());
    return;
  }
  // Names of a message that no tick has seen yet stay, unless this one has them, too.
  if (latest_.number <= taken_) latest_.value.fill(NONE);
  for (std::size_t i = 0; i < message.values.size(); ++i) {
    const auto place = message.names.empty() ? QUANTITIES.begin() + static_cast<std::ptrdiff_t>(i)
                                             : std::find(QUANTITIES.begin(), QUANTITIES.end(), message.names[i]);
    latest_.value[static_cast<std::size_t>(place - QUANTITIES.begin())] = message.values[i];
  }
  latest_.number = ++received_;
  box_.set(latest_);
}

void ArmController::publish() {
  // What may change at run time.
  if (listener_->is_old(params_)) {
    const Params fresh = listener_->get_params();
    smoothness_ = params_.smoothness = fresh.smoothness;
    params_.frame = fresh.frame;
    params_.target_age = fresh.target_age;
    params_.__stamp = fresh.__stamp;
  }
  std_msgs::msg::UInt8 status;
  status.data = static_cast<std::uint8_t>(status_.load());
  status_publisher_->publish(status);
  msg::Target present;
  arm_reference here;
  double q[ARM_JOINTS];
  std::copy(present_.begin(), present_.end(), q);
  // Before the first tick, nobody knows where the arm is.
  if (std::isfinite(q[0])) {
    arm_reference_at(q, &here);
    present.names.assign(QUANTITIES.begin(), QUANTITIES.end());
    present.values.assign(here.value, here.value + ARM_REFERENCE);
  }
  present.header.stamp = get_node()->now();
  present.header.frame_id = params_.frame;
  present_publisher_->publish(present);
  diagnose(status_);
}

// Once a second, and when something changes.
void ArmController::diagnose(int status) {
  const unsigned lost = lost_.exchange(0);
  const int shown = active_ ? status : -2;
  if (shown == diagnosed_ && lost == 0 && ++silent_ < 20) return;
  diagnosed_ = shown;
  silent_ = 0;
  using diagnostic_msgs::msg::DiagnosticStatus;
  DiagnosticStatus entry;
  const bool well = !active_ || status == ARM_OK;
  const bool slight = status == ARM_SATURATED || status == ARM_NEAR_BOUNDARY || status == ARM_RETURNING;
  entry.level = well && lost == 0 ? DiagnosticStatus::OK : well || slight ? DiagnosticStatus::WARN : DiagnosticStatus::ERROR;
  entry.name = std::string(get_node()->get_name()) + ": arm";
  entry.hardware_id = joints_.front() + " to " + joints_.back();
  entry.message = active_ ? explain(status) : "not active";
  if (lost > 0) entry.message += "; commands were not written";
  const auto add = [&entry](const char *key, const std::string &value) {
    diagnostic_msgs::msg::KeyValue pair;
    pair.key = key;
    pair.value = value;
    entry.values.push_back(pair);
  };
  add("status", std::to_string(status));
  add("brakes closed", brakes_closed_ ? "true" : "false");
  add("lost commands", std::to_string(lost));
  diagnostic_msgs::msg::DiagnosticArray array;
  array.header.stamp = get_node()->now();
  array.status.push_back(entry);
  diagnostics_publisher_->publish(array);
}

CallbackReturn ArmController::on_activate(const rclcpp_lifecycle::State & /*previous*/) {
  double q[ARM_JOINTS], dq[ARM_JOINTS], effort[ARM_JOINTS];
  if (state_interfaces_.size() != (params_.effort_states ? 3 : 2) * ARM_JOINTS || command_interfaces_.size() != ARM_JOINTS) {
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
      params_.effort_states && !held ? arm_check_start(&arm_default_safety, q, effort, &arm_default_gains, mismatch) : ARM_OK;
  for (int i = 0; i < ARM_JOINTS && checked == ARM_LOAD_MISMATCH; ++i)
    if (std::fabs(mismatch[i]) > arm_default_safety.start_mismatch[i])
      RCLCPP_ERROR(get_node()->get_logger(), "joint %s is held by %g more than its model says: wrong mounting or tool?",
                   joints_[static_cast<std::size_t>(i)].c_str(), mismatch[i]);
  if (checked != ARM_OK) {
    RCLCPP_ERROR(get_node()->get_logger(), "refused to start: the efforts that hold the arm have status %d", checked);
    return CallbackReturn::ERROR;
  }
  arm_start(&state_, q, ARM_COMMANDS_TORQUE && params_.effort_states && !held ? effort : nullptr);
  if (held) arm_hold(&state_, q, nullptr);
  arm_reference_at(q, &reference_);
  std::copy_n(reference_.value, ARM_REFERENCE, target_.value.begin());
  taken_ = target_.number = received_;  // targets from before the activation are void
  std::copy_n(q, ARM_JOINTS, sent_.begin());
  resume_asked_ = false;
  brakes_asked_ = -1;
  status_ = ARM_OK;
  active_ = true;
  return CallbackReturn::SUCCESS;
}

CallbackReturn ArmController::on_deactivate(const rclcpp_lifecycle::State & /*previous*/) {
  active_ = false;
  if (resume_asked_.exchange(false)) RCLCPP_WARN(get_node()->get_logger(), "deactivated before the arm was resumed");
  return CallbackReturn::SUCCESS;  // the hardware decides what an arm without a controller does
}

// Missing values become NaN: the supervised law then holds its last command, and says BAD_INPUT.
void ArmController::read_robot(double *q, double *dq, double *effort) const {
  const std::size_t each = params_.effort_states ? 3 : 2;
  for (std::size_t i = 0; i < ARM_JOINTS; ++i) {
    q[i] = state_interfaces_[each * i].get_optional().value_or(NONE);
    dq[i] = state_interfaces_[each * i + 1].get_optional().value_or(NONE);
    effort[i] = params_.effort_states ? state_interfaces_[each * i + 2].get_optional().value_or(NONE) : NONE;
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
    if (fresh) taken_ = target_.number = latest->number;  // void: the arm is not where it was meant to start from
    return;
  }
  if (fresh) {
    for (std::size_t i = 0; i < ARM_REFERENCE; ++i)
      if (std::isfinite(latest->value[i])) target_.value[i] = latest->value[i];
    taken_ = target_.number = latest->number;
  }
  arm_reference_stream(&state_, &reference_, target_.value.data(), smoothness_, period);
}

return_type ArmController::update(const rclcpp::Time & /*time*/, const rclcpp::Duration &period) {
  double q[ARM_JOINTS], dq[ARM_JOINTS], effort[ARM_JOINTS], command[ARM_JOINTS];
  bool written = true;
  read_robot(q, dq, effort);
  const int brakes = brakes_asked_.exchange(-1);
  const double *now = ARM_COMMANDS_TORQUE && params_.effort_states ? effort : nullptr;
  if (brakes == 1) arm_hold(&state_, q, now);
  if (brakes == 0) arm_release(&state_, q, now);
  move_reference(q, period.seconds());
  if (resume_asked_.exchange(false)) arm_resume(&state_);
  status_ = arm_step(&state_, &arm_default_safety, q, dq, &reference_, &arm_default_gains, period.seconds(), command);
  // Position interfaces get what the velocities add up to, on a leash: an arm that is stopped must not jump later.
  for (std::size_t i = 0; i < ARM_JOINTS && command_ == hardware_interface::HW_IF_POSITION; ++i) {
    const double lead = LEASH * arm_default_safety.speed_limit[i];
    sent_[i] += command[i] * period.seconds();
    if (std::isfinite(q[i])) sent_[i] = std::clamp(sent_[i], q[i] - lead, q[i] + lead);
    command[i] = sent_[i];
  }
  for (std::size_t i = 0; i < ARM_JOINTS; ++i) written = command_interfaces_[i].set_value(command[i]) && written;
  if (!written) ++lost_;  // an ERROR would deactivate the controller: the arm would lose all its commands for a single one
  std::copy_n(q, ARM_JOINTS, present_.begin());
  return return_type::OK;
}

}  // namespace arm_controller

PLUGINLIB_EXPORT_CLASS(arm_controller::ArmController, controller_interface::ControllerInterface)
