#include "buffer_pool.h"

#include <bit>
#include <mutex>
#include <new>
#include <vector>

namespace vlgs {
namespace {

constexpr std::align_val_t kAlign{64};
#if defined(__SANITIZE_ADDRESS__)
constexpr int64_t kLarge = INT64_MAX;  // a block that is kept or rounded up would hide errors
#else
constexpr int64_t kLarge = 1 << 16;  // bytes
#endif
constexpr size_t kMostBlocks = 64;

struct Block {
  int64_t size;
  void *data;
};

struct Pool {
  Pool() { blocks.reserve(kMostBlocks); }

  std::mutex lock;
  std::vector<Block> blocks;
  int64_t bytes = 0;
};

// Never destroyed: a buffer may be given back while the process ends.
Pool &pool() {
  static Pool *const one = new Pool;
  return *one;
}

// Up to an eighth more than asked for, so that sizes that differ a little from step to step share a block.
int64_t rounded(int64_t bytes) {
  const int64_t step = int64_t(std::bit_floor(uint64_t(bytes))) / 8;
  return (bytes + step - 1) / step * step;
}

}  // namespace

void *take_block(int64_t bytes) {
  if (bytes < kLarge) return ::operator new(size_t(bytes), kAlign);
  const int64_t size = rounded(bytes);
  {
    Pool &s = pool();
    const std::lock_guard guard(s.lock);
    for (Block &b : s.blocks)
      if (b.size == size) {
        void *data = b.data;
        b = s.blocks.back();
        s.blocks.pop_back();
        s.bytes -= size;
        return data;
      }
  }
  return ::operator new(size_t(size), kAlign);
}

void give_block(void *block, int64_t bytes) noexcept {
  if (bytes >= kLarge) {
    const int64_t size = rounded(bytes);
    Pool &s = pool();
    const std::lock_guard guard(s.lock);
    if (s.bytes + size <= kKeptBytes && s.blocks.size() < kMostBlocks) {
      s.blocks.push_back({size, block});
      s.bytes += size;
      return;
    }
  }
  ::operator delete(block, kAlign);
}

}  // namespace vlgs
