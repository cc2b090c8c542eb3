// The part of ros2_control 4.46 (Jazzy) that the example uses, with the same signatures: enough to run it.
#pragma once
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "hardware_interface/loaned_interfaces.hpp"
#include "rclcpp/rclcpp.hpp"
#include "rclcpp_lifecycle/state.hpp"

namespace controller_interface {
enum class CallbackReturn : std::uint8_t { SUCCESS = 97, FAILURE = 98, ERROR = 99 };
enum class return_type : std::uint8_t { OK = 0, ERROR = 1 };
enum class interface_configuration_type : std::uint8_t { ALL = 0, INDIVIDUAL = 1, NONE = 2 };
struct InterfaceConfiguration {
  interface_configuration_type type = interface_configuration_type::NONE;
  std::vector<std::string> names = {};
};

class ControllerInterface {
 public:
  virtual ~ControllerInterface() = default;
  virtual InterfaceConfiguration command_interface_configuration() const = 0;
  virtual InterfaceConfiguration state_interface_configuration() const = 0;
  virtual CallbackReturn on_init() = 0;
  virtual CallbackReturn on_configure(const rclcpp_lifecycle::State &previous_state) = 0;
  virtual CallbackReturn on_activate(const rclcpp_lifecycle::State &previous_state) = 0;
  virtual CallbackReturn on_deactivate(const rclcpp_lifecycle::State &previous_state) = 0;
  virtual return_type update(const rclcpp::Time &time, const rclcpp::Duration &period) = 0;
  std::shared_ptr<rclcpp_lifecycle::LifecycleNode> get_node() const { return node_; }
  void assign_interfaces(std::vector<hardware_interface::LoanedCommandInterface> &&command_interfaces,
                         std::vector<hardware_interface::LoanedStateInterface> &&state_interfaces) {
    command_interfaces_ = command_interfaces;
    state_interfaces_ = state_interfaces;
  }

 protected:
  std::vector<hardware_interface::LoanedCommandInterface> command_interfaces_;
  std::vector<hardware_interface::LoanedStateInterface> state_interfaces_;

 private:
  std::shared_ptr<rclcpp_lifecycle::LifecycleNode> node_ = std::make_shared<rclcpp_lifecycle::LifecycleNode>();
};
}  // namespace controller_interface
