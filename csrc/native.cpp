// Run while the build is configured: the best instruction set of this machine, by the name that VLGS_ISAS has
// for it.
#include <cstdio>

int main() {
  const bool v4 = __builtin_cpu_supports("x86-64-v4"), v3 = __builtin_cpu_supports("x86-64-v3");
  std::printf("%s", v4 ? "v4" : v3 ? "v3" : "base");
}
