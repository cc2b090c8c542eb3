#pragma once
#include <functional>
#include <memory>
#include <string>
#include <vector>

namespace rclcpp {
class Time {};
class Duration {
 public:
  explicit Duration(double seconds) : seconds_(seconds) {}
  double seconds() const { return seconds_; }

 private:
  double seconds_;
};
class Logger {};
class SystemDefaultsQoS {};
struct Parameter {
  std::vector<std::string> names;
  double number = 0.0;
  std::vector<std::string> as_string_array() const { return names; }
  double as_double() const { return number; }
  bool as_bool() const { return number != 0.0; }
};
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
void log_with_format(const Logger &logger, const char *format, ...) __attribute__((format(printf, 2, 3)));
}  // namespace rclcpp
#define RCLCPP_ERROR(logger, ...) ::rclcpp::log_with_format(logger, __VA_ARGS__)
#define RCLCPP_WARN(logger, ...) ::rclcpp::log_with_format(logger, __VA_ARGS__)
