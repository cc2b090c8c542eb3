#pragma once
#include <chrono>
#include <memory>
#include <string>

#include "rclcpp/rclcpp.hpp"

namespace rclcpp_lifecycle {
class State {};

// What the controller made last, by its type, for the program that drives it.
template <typename T>
inline std::shared_ptr<T> made;

class LifecycleNode {
 public:
  double clock = 1.0;  // [s], which a program of tests sets
  rclcpp::Time now() const { return rclcpp::Time(clock); }
  const char *get_name() const { return "arm_controller"; }
  rclcpp::Logger get_logger() const { return {}; }
  template <typename M, typename F>
  std::shared_ptr<rclcpp::Subscription<M>> create_subscription(const std::string &, const rclcpp::SystemDefaultsQoS &,
                                                               F &&callback) {
    return made<rclcpp::Subscription<M>> =
               std::make_shared<rclcpp::Subscription<M>>(rclcpp::Subscription<M>{callback});
  }
  template <typename S, typename F>
  std::shared_ptr<rclcpp::Service<S>> create_service(const std::string &, F &&callback) {
    return made<rclcpp::Service<S>> = std::make_shared<rclcpp::Service<S>>(rclcpp::Service<S>{callback});
  }
  template <typename M>
  std::shared_ptr<rclcpp::Publisher<M>> create_publisher(const std::string &, const rclcpp::SystemDefaultsQoS &) {
    return made<rclcpp::Publisher<M>> = std::make_shared<rclcpp::Publisher<M>>();
  }
  template <typename F>
  std::shared_ptr<rclcpp::TimerBase> create_wall_timer(std::chrono::nanoseconds, F &&callback) {
    return made<rclcpp::TimerBase> = std::make_shared<rclcpp::TimerBase>(rclcpp::TimerBase{callback});
  }
};
}  // namespace rclcpp_lifecycle
