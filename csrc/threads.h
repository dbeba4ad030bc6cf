// How work is divided among threads. No result depends on it.
#pragma once

#include <cstdint>

namespace vlgs {

// Below this much work (rows, or entries of the tile lists) waking other threads takes longer than doing it.
constexpr int64_t kWorthThreads = 4096;
inline int worth(int64_t work, int threads) { return work < kWorthThreads ? 1 : threads; }

// What one thread of several takes of `count` things in a row.
struct Range {
  int64_t begin, end;
};
inline Range share(int64_t count, int thread, int threads) {
  return {count * thread / threads, count * (thread + 1) / threads};
}

}  // namespace vlgs
