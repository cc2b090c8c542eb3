#pragma once
#include <optional>

namespace realtime_tools {
template <typename T>
class RealtimeThreadSafeBox {
 public:
  [[nodiscard]] std::optional<T> try_get() const { return value_; }
  void set(const T &value) { value_ = value; }

 private:
  T value_{};
};
}  // namespace realtime_tools
