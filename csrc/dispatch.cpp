// Which instruction set runs: the best that both the machine and VLGS_ISA allow, decided once.
#include <cstdlib>
#include <stdexcept>
#include <string>

#include "kernels.h"

namespace vlgs {

#define VLGS_DECLARE(ns)                \
  namespace ns {                        \
  extern const Kernels<float> kFloat;   \
  extern const Kernels<double> kDouble; \
  }
VLGS_DECLARE(isa_base)
#if defined(VLGS_X86)
VLGS_DECLARE(isa_v3)
VLGS_DECLARE(isa_v4)
#endif

namespace {

struct Choice {
  const char *name;
  const Kernels<float> *single;
  const Kernels<double> *full;
};

Choice choose() {
  const char *wish = std::getenv("VLGS_ISA");
  const std::string limit = wish ? wish : "v4";
  if (limit != "v4" && limit != "v3" && limit != "base")
    throw std::invalid_argument("VLGS_ISA: must be v4, v3 or base, got " + limit);
#if defined(VLGS_X86)
  __builtin_cpu_init();
  if (limit == "v4" && __builtin_cpu_supports("x86-64-v4")) return {"v4", &isa_v4::kFloat, &isa_v4::kDouble};
  if (limit != "base" && __builtin_cpu_supports("x86-64-v3"))
    return {"v3", &isa_v3::kFloat, &isa_v3::kDouble};
#endif
  return {"base", &isa_base::kFloat, &isa_base::kDouble};
}

const Choice &choice() {
  static const Choice made = choose();
  return made;
}

}  // namespace

const char *isa() { return choice().name; }
template <>
const Kernels<float> &kernels<float>() {
  return *choice().single;
}
template <>
const Kernels<double> &kernels<double>() {
  return *choice().full;
}

}  // namespace vlgs
