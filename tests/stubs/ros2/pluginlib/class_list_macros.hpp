#pragma once
#include <memory>
#define PLUGINLIB_EXPORT_CLASS(Derived, Base) \
  std::shared_ptr<Base> make_plugin();        \
  std::shared_ptr<Base> make_plugin() { return std::make_shared<Derived>(); }
