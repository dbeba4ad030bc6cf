// Which instruction set runs: the best that this build has and that both the machine and VLGS_ISA allow,
// decided once.
#include <algorithm>
#include <cstddef>
#include <cstdlib>
#include <iterator>
#include <stdexcept>
#include <string>

#include "kernels.h"

// VLGS_BUILT is X(v4) X(v3) X(base), or what CMakeLists.txt was asked for of it.
#define X(set)                            \
  namespace vlgs::isa_##set {             \
    extern const Kernels<float> kKernels; \
  }
VLGS_BUILT
#undef X
namespace vlgs::isa_double {
extern const Kernels<double> kKernels;  // for every machine and every choice
}

namespace vlgs {
namespace {

struct Choice {
  const char *name;
  const Kernels<float> *kernels;
};

#define X(set) {#set, &isa_##set::kKernels},
constexpr Choice kBuilt[] = {VLGS_BUILT};
#undef X

constexpr const char *kBestFirst[] = {"v4", "v3", "base"};

std::ptrdiff_t rank(const std::string &name) {
  return std::find(std::begin(kBestFirst), std::end(kBestFirst), name) - std::begin(kBestFirst);
}

bool runs_here(const std::string &name) {
#if defined(__x86_64__)
  if (name == "v4") return __builtin_cpu_supports("x86-64-v4");
  if (name == "v3") return __builtin_cpu_supports("x86-64-v3");
#endif
  return name == "base";
}

Choice choose() {
  const char *wish = std::getenv("VLGS_ISA");
  const std::string limit = wish ? wish : kBestFirst[0];
  if (rank(limit) == std::ssize(kBestFirst))
    throw std::invalid_argument("VLGS_ISA: must be v4, v3 or base, got " + limit);
  std::string names;
  for (const Choice &built : kBuilt) {
    if (rank(built.name) >= rank(limit) && runs_here(built.name)) return built;
    names += std::string(names.empty() ? "" : ", ") + built.name;
  }
  throw std::invalid_argument(
      "VLGS_ISA: must allow an instruction set of this machine that this build has (" + names + "), got " +
      limit + "; install again on this machine, or for many with VLGS_ISAS='v4;v3;base' in the environment");
}

const Choice &choice() {
  static const Choice made = choose();
  return made;
}

}  // namespace

const char *isa() { return choice().name; }
const char *isas() {
  static const std::string made = [] {
    std::string names;
    for (const Choice &built : kBuilt)
      if (runs_here(built.name)) names += std::string(names.empty() ? "" : " ") + built.name;
    return names;
  }();
  return made.c_str();
}
template <>
const Kernels<float> &kernels<float>() {
  return *choice().kernels;
}
template <>
const Kernels<double> &kernels<double>() {
  return isa_double::kKernels;
}

}  // namespace vlgs
