#include "binning.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>

#include "checks.h"

namespace vlgs {
namespace {

template <class T>
struct Candidate {
  std::conditional_t<sizeof(T) == 4, uint32_t, uint64_t>
      depth;  // bits of a positive number, which are in its order
  uint32_t id;
};

constexpr int64_t kRowsAtOnce = 512;  // between forming cutoffs and looking for the tiles they reach

// The box of one record.
template <class T>
Box box_of(const Grid &grid, const T *record, T cutoff) {
  Box box;
  kernels<T>().boxes(grid, 1, record + kMeanX, record + kInvSigmaX, T(1), &cutoff, &box);
  return box;
}

// Stable, least significant digit first. Each thread moves a fixed share of the input, so the result is the
// one stable order.
template <class T>
void sort_by_depth(Buffer<Candidate<T>> &items, int64_t count, int threads) {
  constexpr int kBits = 11, kDigits = 1 << kBits;
  Buffer<Candidate<T>> other(count);
  std::vector<int64_t> places(size_t(threads) * kDigits);
  for (int shift = 0; shift < int(sizeof(T)) * 8; shift += kBits) {
    const auto digit = [shift](const Candidate<T> &c) { return int(c.depth >> shift) & (kDigits - 1); };
    for_shares(threads, [&](int t) {
      int64_t *mine = places.data() + size_t(t) * kDigits;
      std::fill(mine, mine + kDigits, 0);
      const Range r = share(count, t, threads);
      for (int64_t i = r.begin; i < r.end; ++i) ++mine[digit(items[i])];
    });
    int64_t place = 0;
    for (int d = 0; d < kDigits; ++d)
      for (int t = 0; t < threads; ++t) place += std::exchange(places[size_t(t) * kDigits + d], place);
    for_shares(threads, [&](int t) {
      int64_t *mine = places.data() + size_t(t) * kDigits;
      const Range r = share(count, t, threads);
      for (int64_t i = r.begin; i < r.end; ++i) other[mine[digit(items[i])]++] = items[i];
    });
    std::swap(items, other);
  }
}

// Where a Gaussian is looked for, and the widest of its chains.
template <class T>
struct Extent {
  Box box;
  T cutoff;

  int64_t tiles() const { return int64_t(box.x1 - box.x0) * (box.y1 - box.y0); }
};

template <class T>
T widest(const DepthOrder<T> &order, int64_t n, int chains, int64_t i) {
  T cutoff = order.cutoffs[i];
  for (int c = 1; c < chains; ++c) cutoff = std::max(cutoff, order.cutoffs[c * n + i]);
  return cutoff;
}

bool listed(uint16_t mask, const Trim &trim) { return mask || !trim.tile_test; }
uint16_t trimmed(uint16_t mask, const Trim &trim) {
  return !trim.block_masks && listed(mask, trim) ? 0xFFFF : mask;
}

// Whether a Gaussian reaches a pixel, where its masks were made for a wider ellipse.
template <class T>
bool reaches_any(const Grid &grid, const T *g, T cutoff) {
  const Box box = box_of(grid, g, cutoff);
  std::vector<uint16_t> masks(size_t(Extent<T>{box, cutoff}.tiles()));
  kernels<T>().tile_intersect(grid, g, cutoff, box, masks.data());
  return std::any_of(masks.begin(), masks.end(), [](uint16_t mask) { return mask != 0; });
}

void check_budget(int64_t entries, int64_t bytes_each, int64_t budget) {
  if (entries > budget / bytes_each)
    throw std::invalid_argument(
        "rasterize: tile lists must be within memory_budget = " + std::to_string(budget) + " bytes, got " +
        std::to_string(entries) + " entries of " + std::to_string(bytes_each));
}

}  // namespace

template <class T>
DepthOrder<T> sort_visible(const Grid &grid, int64_t n, const Splats<T> &splats,
                           const std::vector<const T *> &weights, T alpha_min, int threads) {
  const int64_t chains = int64_t(weights.size());
  DepthOrder<T> order{0, {}, Buffer<uint32_t>(n), Buffer<T>(chains * n), Buffer<Box>(n)};
  Buffer<Candidate<T>> candidates(n);
  std::vector<int64_t> kept(threads);
  for_shares(threads, [&](int t) {
    const Range r = share(n, t, threads);
    int64_t count = 0;
    for (int64_t first = r.begin; first < r.end; first += kRowsAtOnce) {
      const int64_t end = std::min(first + kRowsAtOnce, r.end);
      T cutoffs[kRowsAtOnce];
      for (int64_t i = first; i < end; ++i) {
        for (int64_t c = 0; c < chains; ++c) {
          const T w = weights[c][i];
          order.cutoffs[c * n + i] = w >= alpha_min ? std::log2(w / alpha_min) : T(-1);
        }
        cutoffs[i - first] = splats.depth[i] > 0 ? widest(order, n, int(chains), i) : T(-1);
      }
      kernels<T>().boxes(grid, end - first, splats.mean2d + 2 * first, splats.ellipse + 3 * first,
                         T(kOctaves), cutoffs, order.boxes.data() + first);
      for (int64_t i = first; i < end; ++i) {
        order.rank_of[i] = kCulled;
        if (order.boxes[i].x0 < order.boxes[i].x1)
          candidates[r.begin + count++] = {std::bit_cast<decltype(Candidate<T>::depth)>(splats.depth[i]),
                                           uint32_t(i)};
      }
    }
    kept[t] = count;
  });
  for (int t = 0; t < threads; ++t) {
    const Candidate<T> *from = candidates.data() + share(n, t, threads).begin;
    std::copy(from, from + kept[t], candidates.data() + order.count);
    order.count += kept[t];
  }
  sort_by_depth<T>(candidates, order.count, threads);
  order.ids = Buffer<uint32_t>(order.count);
  for_each(order.count, threads, [&](int64_t rank) {
    order.ids[rank] = candidates[rank].id;
    order.rank_of[candidates[rank].id] = uint32_t(rank);
  });
  return order;
}

template <class T>
TileLists bin_gaussians(const Grid &grid, int64_t n, const DepthOrder<T> &order, const T *records, int chains,
                        T alpha_min, const Trim &trim, int64_t budget, bool *visible, int threads) {
  const int64_t tiles = grid.tiles_x * grid.tiles_y, m = order.count;
  std::fill(visible, visible + n, false);

  const T full = std::log2(1 / alpha_min);  // the cutoff of a weight of 1
  Buffer<Extent<T>> extents(m);
  Buffer<int64_t> first(m + 1);  // of the masks of each rank
  for_each(m, threads, [&](int64_t rank) {
    const T *g = records + rank * kRecord;
    const uint32_t id = order.ids[rank];
    if (trim.opacity_extent)
      extents[rank] = {order.boxes[id], widest(order, n, chains, id)};
    else
      extents[rank] = {box_of(grid, g, full), full};
    first[rank + 1] = extents[rank].tiles();
  });
  first[0] = 0;
  for (int64_t rank = 0; rank < m; ++rank) first[rank + 1] += first[rank];
  check_budget(first[m], sizeof(uint16_t), budget);

  // Masks over the boxes, and for every thread how many of each tile are not empty.
  Buffer<uint16_t> masks(first[m]);
  std::vector<int64_t> places(size_t(threads) * tiles);
  for_shares(threads, [&](int t) {
    int64_t *mine = places.data() + size_t(t) * tiles;
    const Range r = share(m, t, threads);
    for (int64_t rank = r.begin; rank < r.end; ++rank) {
      const Extent<T> &e = extents[rank];
      uint16_t *mask = masks.data() + first[rank];
      kernels<T>().tile_intersect(grid, records + rank * kRecord, e.cutoff, e.box, mask);
      bool reaches = false;
      for (int64_t y = e.box.y0; y < e.box.y1; ++y)
        for (int64_t x = e.box.x0; x < e.box.x1; ++x, ++mask) {
          reaches |= *mask != 0;
          *mask = trimmed(*mask, trim);
          mine[y * grid.tiles_x + x] += listed(*mask, trim);
        }
      if (!trim.opacity_extent)
        reaches = reaches_any(grid, records + rank * kRecord, widest(order, n, chains, order.ids[rank]));
      visible[order.ids[rank]] = reaches;
    }
  });

  // Within a tile one thread's entries follow the other's, which keeps the order of depth.
  TileLists lists;
  lists.begin.resize(tiles + 1);
  int64_t total = 0;
  for (int64_t tile = 0; tile < tiles; ++tile) {
    lists.begin[tile] = total;
    for (int t = 0; t < threads; ++t) total += std::exchange(places[size_t(t) * tiles + tile], total);
    lists.longest = std::max(lists.longest, total - lists.begin[tile]);
  }
  lists.begin[tiles] = total;
  check_budget(total, sizeof(uint32_t) + sizeof(uint16_t), budget);
  // Places in a list are kept as T.
  if (lists.longest >= int64_t(1) << std::min(std::numeric_limits<T>::digits, 31))
    throw std::invalid_argument("rasterize: Gaussians over one tile must be fewer than 2^24, got " +
                                std::to_string(lists.longest));

  lists.ranks = Buffer<uint32_t>(total);
  lists.masks = Buffer<uint16_t>(total);
  for_shares(threads, [&](int t) {
    int64_t *mine = places.data() + size_t(t) * tiles;
    const Range r = share(m, t, threads);
    for (int64_t rank = r.begin; rank < r.end; ++rank) {
      const Box &box = extents[rank].box;
      const uint16_t *mask = masks.data() + first[rank];
      for (int64_t y = box.y0; y < box.y1; ++y)
        for (int64_t x = box.x0; x < box.x1; ++x, ++mask)
          if (listed(*mask, trim)) {
            const int64_t place = mine[y * grid.tiles_x + x]++;
            lists.ranks[place] = uint32_t(rank);
            lists.masks[place] = *mask;
          }
    }
  });
  return lists;
}

template DepthOrder<float> sort_visible(const Grid &, int64_t, const Splats<float> &,
                                        const std::vector<const float *> &, float, int);
template DepthOrder<double> sort_visible(const Grid &, int64_t, const Splats<double> &,
                                         const std::vector<const double *> &, double, int);
template TileLists bin_gaussians(const Grid &, int64_t, const DepthOrder<float> &, const float *, int, float,
                                 const Trim &, int64_t, bool *, int);
template TileLists bin_gaussians(const Grid &, int64_t, const DepthOrder<double> &, const double *, int,
                                 double, const Trim &, int64_t, bool *, int);

}  // namespace vlgs
