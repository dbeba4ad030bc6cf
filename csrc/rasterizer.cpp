#include "rasterizer.h"

#include <algorithm>
#include <atomic>
#include <limits>
#include <stdexcept>
#include <string>

#include "checks.h"

namespace vlgs {
namespace {

constexpr int64_t kAhead = 16;  // rows between asking for a cache line out of order and using it
// Slots are summed whenever this much has been written: small enough to be in cache still.
constexpr int64_t kSlotBytes = 8 << 20;

constexpr int64_t kWideSlot = 64;  // numbers

// Numbers of a slot that are summed by rank. Where there are hundreds of channels they are summed by row,
// where they belong, because another copy of them all could be the largest array there is.
template <class T>
int64_t summed(const Pass<T> &p) {
  return p.slot_size > kWideSlot ? kSlotHead : p.slot_size;
}

// Adds the slots of one tile to the sums of the ranks in a range, of which the tile's list holds one stretch.
template <class T>
void add_slots(const Pass<T> &p, int64_t tile, Range ranks, const T *slots, T *sums, T *const *d_values) {
  const uint32_t *list = p.ranks + p.tile_begin[tile], *end = p.ranks + p.tile_begin[tile + 1];
  const uint32_t *at = std::lower_bound(list, end, ranks.begin);
  const int64_t size = summed(p);
  for (; at < end && *at < ranks.end; ++at) {
    if (at + kAhead < end) ask_for(sums + at[kAhead] * size, size);
    T *sum = sums + *at * size;
    const T *slot = slots + (at - list) * p.slot_size;
    for (int64_t i = 0; i < size; ++i) sum[i] += slot[i];
    if (size == p.slot_size) continue;
    for (int k = 0; k < p.num_parts; ++k) {
      const Part<T> &part = p.parts[k];
      if (!part.value_grad) continue;
      T *row = d_values[k] + int64_t(p.ids[*at]) * part.channels;
      for (int64_t i = 0; i < part.channels; ++i) row[i] += slot[part.slot + i];
    }
  }
}

// Entries whose slots are held at once, if a tile alone does not hold more.
template <class T>
int64_t entries_at_once(const Pass<T> &p) {
  return std::max<int64_t>(1, kSlotBytes / (p.slot_size * int64_t(sizeof(T))));
}

// Throws for what the tile kernels found.
template <class T>
void refuse_upstream(const Pass<T> &p) {
  const int64_t pixels = p.grid.width * p.grid.height;
  for (int k = 0; k < p.num_parts; ++k)
    if (p.parts[k].d_image)
      check_rows("gradient of images[" + std::to_string(p.parts[k].group) + "] must be finite",
                 p.parts[k].d_image, pixels, p.parts[k].channels, -kLargest, kLargest);
  for (int c = 0; c < p.chains; ++c)
    if (p.d_alphas[c])
      check_rows("gradient of alphas must be finite", p.d_alphas[c], pixels, 1, -kLargest, kLargest);
}

}  // namespace

template <class T>
Rasterized<T>::Rasterized(const Grid &grid, int64_t n, const Splats<T> &splats, std::vector<Chain<T>> chains,
                          std::vector<Part<T>> parts, const RasterizeConfig &config, bool keep, bool *visible,
                          int threads)
    : n_(n), grid_(grid), config_(config), chains_(std::move(chains)), parts_(std::move(parts)) {
  std::vector<const T *> weights;
  if (n >= kCulled)
    throw std::invalid_argument("rasterize: n must be below 2^32 - 1, got " + std::to_string(n));
  for (const Chain<T> &c : chains_) {
    if (any_outside(c.weight, n, T(0), T(1)))
      check_rows("groups[" + std::to_string(c.group) + "].weight must be in [0, 1]", c.weight, n, 1, 0, 1);
    weights.push_back(c.weight);
  }
  const int row_threads = worth(n, threads);
  order_ = sort_visible(grid, n, splats, weights, T(config.alpha_min), row_threads);
  const int num_chains = int(chains_.size());
  for (int first = 0; first < num_chains; first += kMaxChains) {
    stages_.push_back(make_stage(first, std::min(kMaxChains, num_chains - first)));
    fill_records(stages_.back(), splats, row_threads);
  }
  lists_ = bin_gaussians(grid, n, order_, stages_[0].records.data(), num_chains, T(config.alpha_min),
                         config.trim, config.memory_budget, visible, row_threads);
  order_.boxes = {};  // of no use from here on
  for (Stage &s : stages_) {
    if (keep) check_memory(s.pass);
    render(s, keep, worth(lists_.begin.back() + grid.tiles_x * grid.tiles_y, threads));
  }
}

template <class T>
typename Rasterized<T>::Stage Rasterized<T>::make_stage(int first_chain, int num_chains) const {
  Stage s{};
  s.first_chain = first_chain;
  Pass<T> &p = s.pass;
  p.grid = grid_;
  p.alpha_max = T(config_.alpha_max);
  // Backward recovers the light in front of a Gaussian by dividing what is left behind it: where that leaves
  // the range of normal numbers its digits are gone. No value is visible behind so little light.
  const T least =
      std::numeric_limits<T>::min() / std::max(T(1) - p.alpha_max, std::numeric_limits<T>::epsilon());
  p.transmittance_min = std::max(T(config_.transmittance_min), least);
  p.stop_before = config_.stop_before;
  p.chains = num_chains;
  for (int c = 0; c < num_chains; ++c) {
    p.shape_grad[c] = chains_[first_chain + c].shape_grad;
    p.alphas[c] = chains_[first_chain + c].alpha;
  }
  p.slot_size = kSlotHead;
  p.narrow = true;
  for (size_t i = 0; i < parts_.size(); ++i) {
    Part<T> part = parts_[i];
    part.chain -= first_chain;
    if (part.chain < 0 || part.chain >= num_chains) continue;
    if (s.parts.empty()) s.first_part = int(i);
    const int k = int(s.parts.size());
    p.narrow = p.narrow && part.channels == 3 && (num_chains == 1 ? k < kNarrowParts : part.chain == k);
    part.padded = (part.channels + 3) / 4 * 4;
    part.slot = p.slot_size;
    p.slot_size += part.padded;
    p.channels += part.channels;
    p.padded_channels += part.padded;
    s.parts.push_back(part);
  }
  if (p.narrow) p.slot_size = kRecord;
  p.parts = s.parts.data();
  p.num_parts = int(s.parts.size());
  p.ids = order_.ids.data();
  return s;
}

// In the order of the rows: one record is written out of order instead of seven arrays being read so.
template <class T>
void Rasterized<T>::fill_records(Stage &s, const Splats<T> &splats, int threads) const {
  Pass<T> &p = s.pass;
  s.records = Buffer<T>(order_.count * kRecord);
  p.records = s.records.data();
  std::atomic<bool> bad = false;
  for_each(n_, threads, [&](int64_t i) {
    if (const uint32_t next = order_.rank_of[std::min(i + kAhead, n_ - 1)]; next != kCulled)
      __builtin_prefetch(p.records + next * int64_t(kRecord), 1);
    if (order_.rank_of[i] == kCulled) return;
    T *g = s.records.data() + order_.rank_of[i] * int64_t(kRecord);
    const T *mean = splats.mean2d + 2 * i, *ellipse = splats.ellipse + 3 * i;
    g[kMeanX] = mean[0], g[kMeanY] = mean[1];
    g[kInvSigmaX] = ellipse[0] * T(kOctaves), g[kSlope] = ellipse[1],
    g[kInvSigmaY] = ellipse[2] * T(kOctaves);
    for (int c = 0; c < p.chains; ++c) {
      g[kChains0 + 2 * c + kWeight] = chains_[s.first_chain + c].weight[i];
      g[kChains0 + 2 * c + kCutoff] = order_.cutoffs[(s.first_chain + c) * n_ + i];
    }
    if (!p.narrow) set_row(g, uint32_t(i));
    for (int k = 0; k < p.num_parts; ++k) {
      const Part<T> &part = s.parts[k];
      const T *values = part.values + i * part.channels;
      if (any_not_finite(values, part.channels)) bad = true;
      if (p.narrow) std::copy(values, values + 3, g + kValues + 3 * k);
    }
  });
  if (!bad) return;
  for (const Part<T> &part : s.parts)
    check_rows("groups[" + std::to_string(part.group) + "].values must be finite", part.values, n_,
               part.channels, -kLargest, kLargest);
}

// Slots and their sums count towards the budget where gradients may be asked for.
template <class T>
void Rasterized<T>::check_memory(const Pass<T> &p) const {
  const int64_t entries = lists_.begin.back();
  const int64_t slots = std::min(entries, std::max(entries_at_once(p), lists_.longest));
  const int64_t bytes = entries * int64_t(sizeof(uint32_t) + sizeof(uint16_t)) +
                        (slots * p.slot_size + order_.count * summed(p)) * int64_t(sizeof(T));
  if (bytes > config_.memory_budget)
    throw std::invalid_argument("rasterize: tile lists and gradients must be within memory_budget = " +
                                std::to_string(config_.memory_budget) + " bytes, got " +
                                std::to_string(bytes));
}

template <class T>
void Rasterized<T>::render(Stage &s, bool keep, int threads) const {
  Pass<T> &p = s.pass;
  p.tile_begin = lists_.begin.data(), p.ranks = lists_.ranks.data(), p.masks = lists_.masks.data();
  const int64_t tiles = grid_.tiles_x * grid_.tiles_y, pixels = tiles * p.chains * kBlocks * kPixels;
  if (keep) s.transmittance = Buffer<T>(pixels), s.last = Buffer<T>(pixels);
  p.transmittance = s.transmittance.data(), p.last = s.last.data();
  const Kernels<T> &kernel = kernels<T>();
  const int64_t size = kernel.rasterize_forward_scratch(p, lists_.longest),
                list_size = lists_.longest + kListSlack;
  const Buffer<T> scratch(threads * size);
  const Buffer<uint32_t> list(threads * list_size);
  for_each_in_turn(tiles, threads, 1, [&](int64_t tile, int t) {
    kernel.rasterize_forward(p, tile, scratch.data() + t * size, list.data() + t * list_size);
  });
}

// Sum of the slots of every rank, in the order of the tiles whatever the threads: [m, summed]. Wide channels
// are added to d_values.
template <class T>
Buffer<T> Rasterized<T>::sum_slots(const Pass<T> &p, T *const *d_values, int threads) const {
  const int64_t tiles = p.grid.tiles_x * p.grid.tiles_y, size = p.slot_size;
  const int64_t num_sums = order_.count * summed(p), at_once = entries_at_once(p);
  std::vector<int64_t> strips = {0};  // first tile of each
  int64_t most = 0;
  for (int64_t tile = 0; tile < tiles; ++tile) {
    if (p.tile_begin[tile + 1] - p.tile_begin[strips.back()] > at_once && tile > strips.back())
      strips.push_back(tile);
    most = std::max(most, p.tile_begin[tile + 1] - p.tile_begin[strips.back()]);
  }
  strips.push_back(tiles);

  const Kernels<T> &kernel = kernels<T>();
  const int64_t scratch_size = kernel.rasterize_backward_scratch(p, lists_.longest);
  Buffer<T> sums(num_sums), slots(most * size), scratch(threads * scratch_size);
  std::atomic<bool> bad = false;
  for_shares(threads, [&](int t) {
    const Range mine = share(num_sums, t, threads);
    std::fill(sums.data() + mine.begin, sums.data() + mine.end, T(0));
  });
  for (size_t s = 0; s + 1 < strips.size(); ++s) {
    const int64_t first = strips[s], base = p.tile_begin[first];
    const auto slots_of = [&](int64_t tile) { return slots.data() + (p.tile_begin[tile] - base) * size; };
    for_each_in_turn(strips[s + 1] - first, threads, 1, [&](int64_t i, int t) {
      if (!kernel.rasterize_backward(p, first + i, scratch.data() + t * scratch_size, slots_of(first + i)))
        bad = true;
    });
    for_shares(threads, [&](int t) {
      const Range ranks = share(order_.count, t, threads);
      for (int64_t tile = first; tile < strips[s + 1]; ++tile)
        add_slots(p, tile, ranks, slots_of(tile), sums.data(), d_values);
    });
  }
  if (bad) refuse_upstream(p);
  return sums;
}

// From moments to gradients (csrc/README.md), and from ranks to rows.
template <class T>
void Rasterized<T>::write_gradients(const Stage &s, const Pass<T> &p, const Buffer<T> &sums,
                                    const RasterizeGrads<T> &d, int threads) const {
  constexpr T kPerOctave = T(1 / kOctaves), kPerOctave2 = T(1 / (kOctaves * kOctaves));
  const int64_t size = summed(p);
  const bool by_row = size < p.slot_size;
  T *const *d_weights = d.d_weights.data() + s.first_chain, *const *d_values =
                                                                d.d_values.data() + s.first_part;
  std::atomic<bool> bad = false;
  for_each(n_, threads, [&](int64_t i) {
    static constexpr T kNothing[kRecord] = {};
    const bool seen = order_.rank_of[i] != kCulled;
    if (const uint32_t next = order_.rank_of[std::min(i + kAhead, n_ - 1)]; next != kCulled) {
      ask_for(sums.data() + next * size, size);
      __builtin_prefetch(p.records + next * int64_t(kRecord));
    }
    const T *sum = seen ? sums.data() + order_.rank_of[i] * size : kNothing;
    const T *g = seen ? p.records + order_.rank_of[i] * int64_t(kRecord) : kNothing;
    if (seen && any_not_finite(sum, size)) bad = true;
    for (int c = 0; c < p.chains; ++c) {
      const T weight = g[kChains0 + 2 * c + kWeight];
      if (d_weights[c]) d_weights[c][i] = weight > 0 ? sum[kSlotWeight0 + c] / weight : T(0);
    }
    for (int k = 0; k < p.num_parts; ++k) {
      const Part<T> &part = p.parts[k];
      if (!d_values[k]) continue;
      T *to = d_values[k] + i * part.channels;
      const T *from = sum + (p.narrow ? kSlotValues + 3 * k : part.slot);
      if (by_row)
        bad = bad || any_not_finite(to, part.channels);
      else if (seen && part.value_grad)
        std::copy(from, from + part.channels, to);
      else
        std::fill(to, to + part.channels, T(0));
    }
    if (!seen || !p.shape_grads) return;
    const T a = g[kInvSigmaX], slope = g[kSlope], b = g[kInvSigmaY];
    if (T *d_mean = d.d_mean2d + 2 * i; d.d_mean2d) {
      d_mean[0] += kPerOctave2 * a * sum[kMomentU];
      d_mean[1] += kPerOctave2 * (b * sum[kMomentV] - a * slope * sum[kMomentU]);
    }
    if (T *d_ellipse = d.d_ellipse + 3 * i; d.d_ellipse) {
      d_ellipse[0] -= kPerOctave * sum[kMomentUU] / a;
      d_ellipse[1] += kPerOctave2 * (a / b) * sum[kMomentUV];
      d_ellipse[2] -= kPerOctave * sum[kMomentVV] / b;
    }
  });
  if (!bad) return;
  for (int c = 0; c < p.chains; ++c)
    if (d_weights[c])
      check_rows("gradient of a weight must be finite", d_weights[c], n_, 1, -kLargest, kLargest);
  for (int k = 0; k < p.num_parts; ++k)
    if (d_values[k])
      check_rows("gradient of groups[" + std::to_string(p.parts[k].group) + "].values must be finite",
                 d_values[k], n_, p.parts[k].channels, -kLargest, kLargest);
  if (d.d_mean2d) check_rows("gradient of mean2d must be finite", d.d_mean2d, n_, 2, -kLargest, kLargest);
  if (d.d_ellipse)
    check_rows("gradient of the ellipses (means, quats, scales) must be finite", d.d_ellipse, n_, 3,
               -kLargest, kLargest);
  // A sum of which nothing was asked for.
  for (int64_t i = 0; i < n_; ++i)
    if (const uint32_t rank = order_.rank_of[i];
        rank != kCulled && any_not_finite(sums.data() + rank * size, size))
      throw std::invalid_argument("rasterize: sums of the gradients must be finite, got others in row " +
                                  std::to_string(i));
}

template <class T>
void Rasterized<T>::backward(const RasterizeGrads<T> &d, int threads) const {
  const int tile_threads = worth(lists_.begin.back() + grid_.tiles_x * grid_.tiles_y, threads);
  if (d.d_mean2d) std::fill_n(d.d_mean2d, 2 * n_, T(0));
  if (d.d_ellipse) std::fill_n(d.d_ellipse, 3 * n_, T(0));
  for (const Stage &s : stages_) {
    Pass<T> p = s.pass;
    std::vector<Part<T>> parts = s.parts;
    p.parts = parts.data();
    p.shape_grads = p.weight_grads = p.value_grads = false;
    for (int c = 0; c < p.chains; ++c) {
      p.d_alphas[c] = d.d_alphas[s.first_chain + c];
      p.used[c] = p.d_alphas[c];
      p.weight_grads |= d.d_weights[s.first_chain + c] != nullptr;
    }
    if (!p.narrow) p.slot_size = kSlotHead;
    for (int k = 0; k < p.num_parts; ++k) {
      Part<T> &part = parts[k];
      T *to = d.d_values[s.first_part + k];
      part.values = d.values[s.first_part + k];
      part.d_image = d.d_images[s.first_part + k];
      part.value_grad = part.d_image && to;
      part.slot = p.slot_size;
      p.used[part.chain] |= part.d_image != nullptr;
      p.value_grads |= part.value_grad;
      if (part.value_grad && !p.narrow) p.slot_size += part.padded;
    }
    if (summed(p) < p.slot_size)
      for (int k = 0; k < p.num_parts; ++k)
        if (T *to = d.d_values[s.first_part + k]) std::fill_n(to, n_ * parts[k].channels, T(0));
    for (int c = 0; c < p.chains; ++c) p.shape_grads |= p.used[c] && p.shape_grad[c];
    p.shape_grads &= d.d_mean2d || d.d_ellipse;
    write_gradients(s, p, sum_slots(p, d.d_values.data() + s.first_part, tile_threads), d,
                    worth(n_, threads));
  }
}

template <class T>
void Rasterized<T>::median_rows(int64_t *rows, int threads) const {
  const Pass<T> &p = stages_[0].pass;
  if (!p.transmittance)
    throw std::invalid_argument("rasterize: keep must be true where the median is asked for, got false");
  const int64_t tiles = grid_.tiles_x * grid_.tiles_y;
  for_each_in_turn(tiles, worth(lists_.begin.back() + tiles, threads), 1,
                   [&](int64_t tile, int) { kernels<T>().median_rows(p, tile, rows); });
}

template <class T>
RasterizeWork Rasterized<T>::work() const {
  RasterizeWork work{lists_.begin.back(), 0};
  for (const Stage &s : stages_) {
    const Pass<T> &p = s.pass;
    if (p.stop_before)
      throw std::invalid_argument("rasterize: stop must be after where work is counted, got before");
    if (!p.transmittance)
      throw std::invalid_argument("rasterize: keep must be true where work is counted, got false");
    for (int64_t tile = 0; tile < grid_.tiles_x * grid_.tiles_y; ++tile)
      for (int b = 0; b < kBlocks; ++b) {
        // Where every pixel is done in every chain a block ends behind its last contribution.
        bool done = true;
        T end = -1;
        for (int c = 0; c < p.chains; ++c) {
          const int64_t where = ((tile * p.chains + c) * kBlocks + b) * kPixels;
          for (int64_t i = where; i < where + kPixels; ++i) {
            done &= p.transmittance[i] <= p.transmittance_min;
            end = std::max(end, p.last[i]);
          }
        }
        const int64_t begin = p.tile_begin[tile], count = p.tile_begin[tile + 1] - begin;
        const int64_t visited = done ? int64_t(end) + 1 : count;
        for (int64_t k = begin; k < begin + visited; ++k) work.weighed += (p.masks[k] >> b & 1) * p.chains;
      }
  }
  return work;
}

template class Rasterized<float>;
template class Rasterized<double>;

}  // namespace vlgs
