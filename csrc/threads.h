// How work is divided among threads. No result depends on it.
//
// The threads are the module's own (threads.cpp): OpenMP's spin or sleep as the environment said when torch
// was loaded, and a child process cannot use those of its parent.
#pragma once

#include <algorithm>
#include <atomic>
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

// Calls do_share(work, s) once for every s in [0, shares), on up to so many threads, this one among them;
// returns when all are done. Throws the first exception of a share, in whose place others may be left out.
using DoShare = void (*)(const void *work, int share);
void run_shares(int shares, DoShare do_share, const void *work);

template <class Call>
void for_shares(int shares, const Call &call) {
  if (shares == 1) return call(0);
  run_shares(shares, [](const void *work, int s) { (*static_cast<const Call *>(work))(s); }, &call);
}

// Every i in [0, count), in stretches of equal length, one for each share: call(i).
template <class Call>
void for_each(int64_t count, int threads, const Call &call) {
  for_shares(threads, [&](int s) {
    const Range r = share(count, s, threads);
    for (int64_t i = r.begin; i < r.end; ++i) call(i);
  });
}

// Every i in [0, count), for things of unequal size: whoever is free takes the next `at_once` of them. A
// share is done by one thread, so that scratch memory can be its own: call(i, share).
template <class Call>
void for_each_in_turn(int64_t count, int threads, int64_t at_once, const Call &call) {
  std::atomic<int64_t> next = 0;
  for_shares(threads, [&](int s) {
    for (int64_t i; (i = next.fetch_add(at_once, std::memory_order_relaxed)) < count;)
      for (const int64_t end = std::min(i + at_once, count); i < end; ++i) call(i, s);
  });
}

}  // namespace vlgs
