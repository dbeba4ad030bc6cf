// Memory for arrays that are written before they are read: aligned to a cache line, not initialised.
#pragma once

#include <cstdint>
#include <memory>

namespace vlgs {

// Large blocks are kept when given back, up to kKeptBytes in all, because the kernel's arrays have the same
// sizes step after step, and memory fresh from the system costs more to touch than these arrays cost to fill.
constexpr int64_t kKeptBytes = 256 << 20;
void *take_block(int64_t bytes);
void give_block(void *block, int64_t bytes) noexcept;

template <class T>
class Buffer {
 public:
  Buffer() = default;
  explicit Buffer(int64_t count)
      : data_(static_cast<T *>(take_block(count * int64_t(sizeof(T)))), Give{count * int64_t(sizeof(T))}) {}

  T *data() const { return data_.get(); }
  T &operator[](int64_t i) const { return data_.get()[i]; }

 private:
  struct Give {
    int64_t bytes = 0;
    void operator()(T *block) const { give_block(block, bytes); }
  };
  std::unique_ptr<T, Give> data_;
};

}  // namespace vlgs
