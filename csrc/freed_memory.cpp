#include "freed_memory.h"

#include <cstdlib>  // says whether this is glibc

#if defined(__GLIBC__)
#include <malloc.h>
#endif

namespace vlgs {

void keep_freed_memory([[maybe_unused]] bool on) {
#if defined(__GLIBC__)
  // Setting any of them ends glibc's own adjustment of the thresholds; "off" is where that would have led.
  constexpr int kMaps = 1 << 16, kLargestOfHeap = 32 << 20, kMostKept = 512 << 20;
  mallopt(M_MMAP_MAX, on ? 0 : kMaps);
  mallopt(M_MMAP_THRESHOLD, kLargestOfHeap);
  mallopt(M_TRIM_THRESHOLD, on ? kMostKept : 2 * kLargestOfHeap);
  if (!on) malloc_trim(0);
#endif
}

}  // namespace vlgs
