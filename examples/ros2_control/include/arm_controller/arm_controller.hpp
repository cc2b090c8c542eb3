// A supervised law that orthocas generated under the name `arm`, as a controller of ros2_control.
#ifndef ARM_CONTROLLER__ARM_CONTROLLER_HPP_
#define ARM_CONTROLLER__ARM_CONTROLLER_HPP_

#include <array>
#include <atomic>
#include <cstdint>
#include <string>
#include <vector>

#include "arm.h"
#include "controller_interface/controller_interface.hpp"
#include "rclcpp/rclcpp.hpp"
#include "rclcpp_lifecycle/state.hpp"
#include "realtime_tools/realtime_thread_safe_box.hpp"
#include "std_msgs/msg/float64_multi_array.hpp"
#include "std_msgs/msg/u_int8.hpp"
#include "std_srvs/srv/set_bool.hpp"
#include "std_srvs/srv/trigger.hpp"

namespace arm_controller {

// Topics and services: ~/target takes values for all controlled quantities, in the order of arm.h; ~/status publishes
// the arm_status of the last tick and ~/present the quantities, 20 times a second; ~/resume asks for the law after the
// catcher took over, and refuses when it did not; ~/brakes is told true when brakes have closed, and false before they
// open, and keeps that for the next activation.
class ArmController : public controller_interface::ControllerInterface {
 public:
  controller_interface::CallbackReturn on_init() override;
  controller_interface::InterfaceConfiguration command_interface_configuration() const override;
  controller_interface::InterfaceConfiguration state_interface_configuration() const override;
  controller_interface::CallbackReturn on_configure(const rclcpp_lifecycle::State &previous) override;
  controller_interface::CallbackReturn on_activate(const rclcpp_lifecycle::State &previous) override;
  controller_interface::CallbackReturn on_deactivate(const rclcpp_lifecycle::State &previous) override;
  controller_interface::return_type update(const rclcpp::Time &time, const rclcpp::Duration &period) override;

 private:
  struct Target {
    std::uint64_t number = 0;  // of the message, to tell a new one from the last one
    std::array<double, ARM_REFERENCE> value{};
  };

  void read_robot(double *q, double *dq, double *effort) const;
  void publish();
  void move_reference(const double *q, double period);

  std::vector<std::string> joints_;
  std::atomic<double> smoothness_{0.0};
  std::atomic<bool> active_{false};
  bool effort_states_ = false;
  std::atomic<std::uint64_t> received_{0};  // messages
  realtime_tools::RealtimeThreadSafeBox<Target> box_;
  std::atomic<bool> resume_asked_{false};
  std::atomic<int> brakes_asked_{-1};  // 1: they have closed; 0: they open; -1: nothing new
  std::atomic<bool> brakes_closed_{false};
  std::atomic<int> status_{ARM_OK};
  std::atomic<unsigned> lost_{0};  // ticks in which a command could not be written
  std::array<std::atomic<double>, ARM_JOINTS> present_{};

  // Of the real-time thread.
  arm_state state_{};
  arm_reference reference_{};
  Target target_;

  rclcpp::Subscription<std_msgs::msg::Float64MultiArray>::SharedPtr target_subscription_;
  rclcpp::Service<std_srvs::srv::Trigger>::SharedPtr resume_service_;
  rclcpp::Service<std_srvs::srv::SetBool>::SharedPtr brakes_service_;
  rclcpp::Publisher<std_msgs::msg::UInt8>::SharedPtr status_publisher_;
  rclcpp::Publisher<std_msgs::msg::Float64MultiArray>::SharedPtr present_publisher_;
  rclcpp::TimerBase::SharedPtr status_timer_;
};

}  // namespace arm_controller

#endif  // ARM_CONTROLLER__ARM_CONTROLLER_HPP_
