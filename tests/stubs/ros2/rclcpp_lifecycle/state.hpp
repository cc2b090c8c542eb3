#pragma once
#include <chrono>
#include <map>
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
  std::map<std::string, rclcpp::Parameter> parameters;
  rclcpp::Logger get_logger() const { return {}; }
  rclcpp::Parameter get_parameter(const std::string &name) const { return parameters.at(name); }
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
