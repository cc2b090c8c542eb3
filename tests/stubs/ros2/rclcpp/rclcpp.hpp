#pragma once
#include <cmath>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "builtin_interfaces/msg/time.hpp"

enum rcl_clock_type_t { RCL_CLOCK_UNINITIALIZED = 0, RCL_ROS_TIME, RCL_SYSTEM_TIME, RCL_STEADY_TIME };

namespace rclcpp {
class Duration {
 public:
  explicit Duration(double seconds) : seconds_(seconds) {}
  double seconds() const { return seconds_; }

 private:
  double seconds_;
};
class Time {
 public:
  explicit Time(double seconds = 0.0) : seconds_(seconds) {}
  Time(const builtin_interfaces::msg::Time &stamp, rcl_clock_type_t /*clock_type*/ = RCL_ROS_TIME)
      : seconds_(stamp.sec + 1e-9 * stamp.nanosec) {}
  operator builtin_interfaces::msg::Time() const {
    builtin_interfaces::msg::Time stamp;
    stamp.sec = static_cast<std::int32_t>(seconds_);
    stamp.nanosec = static_cast<std::uint32_t>(1e9 * (seconds_ - stamp.sec));
    return stamp;
  }
  rcl_clock_type_t get_clock_type() const { return RCL_ROS_TIME; }
  Duration operator-(const Time &other) const { return Duration(seconds_ - other.seconds_); }
  bool operator!=(const Time &other) const { return seconds_ != other.seconds_; }

 private:
  double seconds_;
};
class Logger {};
class SystemDefaultsQoS {};
template <typename M>
struct Subscription {
  using SharedPtr = std::shared_ptr<Subscription>;
  std::function<void(std::shared_ptr<M>)> callback;
};
template <typename S>
struct Service {
  using SharedPtr = std::shared_ptr<Service>;
  std::function<void(std::shared_ptr<typename S::Request>, std::shared_ptr<typename S::Response>)> callback;
};
template <typename M>
struct Publisher {
  using SharedPtr = std::shared_ptr<Publisher>;
  M last;
  void publish(const M &message) { last = message; }
};
struct TimerBase {
  using SharedPtr = std::shared_ptr<TimerBase>;
  std::function<void()> callback;
};
inline int warnings = 0;  // and errors, logged so far
void log_with_format(const Logger &logger, const char *format, ...) __attribute__((format(printf, 2, 3)));
}  // namespace rclcpp
#define RCLCPP_ERROR(logger, ...) ::rclcpp::log_with_format(logger, __VA_ARGS__)
#define RCLCPP_WARN(logger, ...) ::rclcpp::log_with_format(logger, __VA_ARGS__)
