// A supervised law that orthocas generated under the name `arm`, as a controller of ros2_control.
#ifndef ARM_CONTROLLER__ARM_CONTROLLER_HPP_
#define ARM_CONTROLLER__ARM_CONTROLLER_HPP_

#include <array>
#include <atomic>
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "arm.h"
#include "arm_controller/arm_controller_parameters.hpp"
#include "arm_controller/msg/target.hpp"
#include "controller_interface/controller_interface.hpp"
#include "diagnostic_msgs/msg/diagnostic_array.hpp"
#include "rclcpp/rclcpp.hpp"
#include "rclcpp_lifecycle/state.hpp"
#include "realtime_tools/realtime_thread_safe_box.hpp"
#include "std_msgs/msg/u_int8.hpp"
#include "std_srvs/srv/set_bool.hpp"
#include "std_srvs/srv/trigger.hpp"

namespace arm_controller {

// Topics and services: ~/target takes values for named quantities, stamped and in a frame; ~/present publishes where they
// are and ~/status the arm_status of the last tick, 20 times a second; /diagnostics says the same to people, when it changes
// and once a second; ~/resume asks for the law after the catcher took over, and refuses when it did not; ~/brakes is told
// true when brakes have closed, and false before they open, and keeps that for the next activation.
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
  // Values by quantity, in the order of arm.h; NaN: stays as it was.
  struct Goal {
    std::uint64_t number = 0;  // of the message, to tell a new one from the last one
    std::array<double, ARM_REFERENCE> value{};
  };

  std::string refusal(const msg::Target &message) const;
  void receive(const msg::Target &message);
  void read_robot(double *q, double *dq, double *effort) const;
  void publish();
  void diagnose(int status);
  void move_reference(const double *q, double period);

  std::shared_ptr<ParamListener> listener_;
  Params params_;
  std::vector<std::string> joints_;  // in the order of arm.h
  std::string command_;
  std::atomic<double> smoothness_{0.0};
  std::atomic<bool> active_{false};
  std::atomic<std::uint64_t> received_{0};  // targets
  std::atomic<std::uint64_t> taken_{0};     // number of the last one that the real-time thread has
  Goal latest_;
  realtime_tools::RealtimeThreadSafeBox<Goal> box_;
  std::atomic<bool> resume_asked_{false};
  std::atomic<int> brakes_asked_{-1};  // 1: they have closed; 0: they open; -1: nothing new
  std::atomic<bool> brakes_closed_{false};
  std::atomic<int> status_{ARM_OK};
  std::atomic<unsigned> lost_{0};  // ticks in which a command could not be written
  std::array<std::atomic<double>, ARM_JOINTS> present_{};
  int diagnosed_ = -1;  // status of the last diagnosis
  int silent_ = 0;      // times that nothing was diagnosed since

  // Of the real-time thread.
  arm_state state_{};
  arm_reference reference_{};
  Goal target_;
  std::array<double, ARM_JOINTS> sent_{};  // positions that were commanded

  rclcpp::Subscription<msg::Target>::SharedPtr target_subscription_;
  rclcpp::Service<std_srvs::srv::Trigger>::SharedPtr resume_service_;
  rclcpp::Service<std_srvs::srv::SetBool>::SharedPtr brakes_service_;
  rclcpp::Publisher<std_msgs::msg::UInt8>::SharedPtr status_publisher_;
  rclcpp::Publisher<msg::Target>::SharedPtr present_publisher_;
  rclcpp::Publisher<diagnostic_msgs::msg::DiagnosticArray>::SharedPtr diagnostics_publisher_;
  rclcpp::TimerBase::SharedPtr status_timer_;
};

}  // namespace arm_controller

#endif  // ARM_CONTROLLER__ARM_CONTROLLER_HPP_
