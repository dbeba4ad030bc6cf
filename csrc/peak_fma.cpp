// The fastest that this machine computes: multiply-adds that wait for nothing but each other.
#include "isa.h"
#include "simd.h"

namespace vlgs::VLGS_ISA_NS {

T peak_fma(int64_t rounds, T factor, T addend) {
  using Native = typename Pack<T>::Native;
  constexpr int kParts = Pack<T>::kParts;
  const Native a = factor - Native{}, b = addend - Native{};
  Native sums[kPeakFmaPacks];  // each from another number, or they would be one
  for (int k = 0; k < kPeakFmaPacks; ++k) sums[k] = T(k) * b;
  // Ten registers at a time hide the latency of any machine and fit where there are sixteen.
  for (int64_t i = 0; i < rounds * kParts; ++i)
    for (Native &sum : sums) sum = native_fma(sum, a, b);
  Native total = {};
  for (const Native &sum : sums) total += sum;
  return total[0];
}

}  // namespace vlgs::VLGS_ISA_NS
