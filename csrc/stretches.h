// Pixels that count and pixels that do not, stretch by stretch: masks are made of long ones.
#pragma once

#include <cstring>

#include "simd.h"

namespace vlgs::VLGS_ISA_NS {

// Calls with every stretch of pixels in [begin, end) that count, or do not. All count without a mask.
template <class Call>
VLGS_INLINE void for_stretches(const bool *valid, int64_t begin, int64_t end, Call call) {
  if (!valid) return call(begin, end, true);
  while (begin < end) {
    const void *other = std::memchr(valid + begin, !valid[begin], size_t(end - begin));
    const int64_t stop = other ? static_cast<const bool *>(other) - valid : end;
    call(begin, stop, valid[begin]);
    begin = stop;
  }
}

}  // namespace vlgs::VLGS_ISA_NS
