// What generate_parameter_library makes of src/arm_controller_parameters.yaml; a test compares the fields.
#pragma once
#include <memory>
#include <string>
#include <vector>

#include "rclcpp_lifecycle/state.hpp"
namespace arm_controller {
struct Params {
  std::vector<std::string> joints = {};
  std::string command = "";
  bool effort_states = false;
  double smoothness = 3.0;
  std::string frame = "";
  double target_age = 0.5;
  rclcpp::Time __stamp;
};
inline Params set_params;  // what a program of tests sets

class ParamListener {
 public:
  ParamListener(const std::shared_ptr<rclcpp_lifecycle::LifecycleNode> & /*node*/, const std::string & /*prefix*/ = "") {}
  Params get_params() const { return set_params; }
  bool is_old(const Params &other) const { return set_params.__stamp != other.__stamp; }
};
}  // namespace arm_controller
