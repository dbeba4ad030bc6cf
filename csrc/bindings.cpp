// The module that Python sees: one file of bindings per operation, and which machine runs them.
#include "bindings.h"

#include "freed_memory.h"
#include "kernels.h"

namespace vlgs {
namespace {

// At least so many 16-lane multiply-adds of floats in this thread, for who takes the time; returns how many.
int64_t peak_fma(int64_t packs) {
  nb::gil_scoped_release unlocked;
  const int64_t rounds = packs / kPeakFmaPacks + 1;
  volatile float kept = kernels<float>().peak_fma(rounds, 0.5f, 1.0f);
  (void)kept;
  return rounds * kPeakFmaPacks;
}

}  // namespace
}  // namespace vlgs

NB_MODULE(_csrc, m) {
  using namespace vlgs;
  // Graphs and caches of Python that outlive this module hold on to its objects; nanobind would call that a
  // leak.
  nb::set_leak_warnings(false);
  isa();  // a wish that cannot be met ends the import; later it would be thrown inside a parallel loop
  m.def("isa", &isa);
  m.def("isas", &isas);
  m.def("peak_fma", &peak_fma, "packs"_a);
  m.def("keep_freed_memory", &keep_freed_memory, "on"_a);
  bind_project(m);
  bind_rasterize(m);
  bind_attention(m);
  bind_view_color(m);
  bind_ssim(m);
  bind_squared_error(m);
  bind_cached_weights(m);
  bind_code_table(m);
  bind_learning(m);
}
