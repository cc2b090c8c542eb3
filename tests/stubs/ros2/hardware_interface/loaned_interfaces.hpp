#pragma once
#include <optional>

namespace hardware_interface {
class LoanedStateInterface {
 public:
  explicit LoanedStateInterface(const double *value) : value_(value) {}
  template <typename T = double>
  [[nodiscard]] std::optional<T> get_optional(unsigned int /*max_tries*/ = 10) const {
    return *value_ == *value_ ? std::optional<T>(*value_) : std::nullopt;
  }

 private:
  const double *value_;
};

class LoanedCommandInterface {
 public:
  explicit LoanedCommandInterface(double *value) : value_(value) {}
  template <typename T>
  [[nodiscard]] bool set_value(const T &value, unsigned int /*max_tries*/ = 10) {
    *value_ = value;
    return true;
  }

 private:
  double *value_;
};
}  // namespace hardware_interface
