// What the kernels work on, and the list of them (VLGS_KERNELS). They know arrays and nothing else: no
// Python, no threads, no allocation. Every kernel is compiled once per instruction set for float, into that
// set's namespace, and chosen at run time (dispatch.cpp); for double once, for any machine.
//
// Matrices are row by row. n Gaussians in the caller's order; m visible ones in the order of (depth, row),
// "ranks".
#pragma once

#include <cstdint>
#include <cstring>

#include "attention.h"
#include "code_table.h"
#include "mapped_error.h"
#include "neighbours.h"
#include "radam.h"
#include "squared_error.h"
#include "ssim.h"

namespace vlgs {

constexpr int kTile = 16;                // pixels on a side of a tile
constexpr int kBlock = 4;                // pixels on a side of a block
constexpr int kBlocks = 16;              // blocks of a tile, and bits of a block mask: row by row
constexpr int kPixels = 16;              // pixels of a block, row by row
constexpr int kRecord = 16;              // numbers kept for one visible Gaussian
constexpr int kMaxChains = 2;            // transmittances carried in one pass over the tiles
constexpr int kNarrowParts = 2;          // parts of 3 channels for which a record has room
constexpr int kPeakFmaPacks = 10;        // packs of multiply-adds in a round of peak_fma
constexpr int kCachedWeightsAhead = 16;  // entries between asking for a kept weight and using it
constexpr int kGatherAhead = 16;         // entries between asking for a record and copying it
constexpr int kListSlack = 16;           // entries that a block's list may be written beyond its end
constexpr int kWeightsAhead = 64;        // blending weights formed before any wide channels are summed

// Exponents are in octaves: weight falls off as 2^-(u^2 + v^2) with u, v scaled by kOctaves = sqrt(log2(e) /
// 2).
constexpr double kOctaves = 0.849321800288019099;

struct Camera {
  double rotation[9], translation[3];  // world to camera
  double fx, fy, cx, cy;               // pixels
  double slope_low[2], slope_high[2];  // where x/z and y/z are clamped in the Jacobian
  double near, near_sigmas, blur;      // world units; standard deviations along the view axis; pixel^2
};

// On the image plane a Gaussian is an ellipse written row by row: given y, x is normal about
// mean_x + slope (y - mean_y) with deviation sigma_x, and y is normal about mean_y with deviation sigma_y.
template <class T>
struct Splats {
  T *mean2d;   // [n, 2] pixels
  T *ellipse;  // [n, 3] (1 / sigma_x, slope, 1 / sigma_y)
  T *depth;    // [n] world units; 0 marks a Gaussian that is culled
};

template <class T>
struct Gaussians {
  const T *means, *quats, *scales;  // [n, 3], [n, 4], [n, 3]
};

template <class T>
struct GaussianGrads {
  const T *depth;                   // [n] as the projection left it
  const T *d_mean2d, *d_ellipse;    // [n, 2], [n, 3]: given
  T *d_means, *d_quats, *d_scales;  // [n, 3], [n, 4], [n, 3]: written
};

struct Grid {
  int64_t width, height;  // pixels
  int64_t tiles_x, tiles_y;
};

// Tiles [x0, x1) x [y0, y1).
struct Box {
  int32_t x0, y0, x1, y1;
};

// A record: what the tile kernels read of a visible Gaussian, one cache line of floats.
enum Record {
  kMeanX,
  kMeanY,
  kInvSigmaX,
  kSlope,
  kInvSigmaY,
  kChains0,
  kValues = kChains0 + 2 * kMaxChains,
  kPlace = kRecord - 1  // in the list of the tile at hand
};
constexpr int kWeight = 0, kCutoff = 1;  // record[kChains0 + 2 chain + ...]
// Wide values stay where they are: the record has the bits of the Gaussian's row in place of them. These are
// always inline, so that no instruction set gets another one's copy.
template <class T>
[[gnu::always_inline]] inline void set_row(T *record, uint32_t row) {
  std::memcpy(record + kValues, &row, sizeof row);
}
template <class T>
[[gnu::always_inline]] inline int64_t row_of(const T *record) {
  uint32_t row;
  std::memcpy(&row, record + kValues, sizeof row);
  return row;
}

// Asks for the cache lines of `count` numbers. GCC drops calls of a function that does nothing else, unless
// it is inlined.
template <class T>
[[gnu::always_inline]] inline void ask_for(const T *from, int64_t count) {
  constexpr int64_t kLine = 64 / sizeof(T);
  for (int64_t k = 0; k < count; k += kLine) __builtin_prefetch(from + k);
  __builtin_prefetch(from + count - 1);
}

// One group of channels; several may hang on one chain.
template <class T>
struct Part {
  const T *values;   // [n, channels]
  const T *d_image;  // [height, width, channels], backward only; null where the image was not used
  T *image;          // [height, width, channels], forward only
  int64_t channels;
  int64_t padded;   // channels rounded up to 4, backward only
  int64_t slot;     // where its gradients begin in a slot, backward only
  bool value_grad;  // whether they are wanted, backward only
  int chain;
  int group;  // for messages
};

// Everything a tile needs; one pass blends at most kMaxChains chains.
template <class T>
struct Pass {
  Grid grid;
  T alpha_max, transmittance_min;
  bool stop_before;
  int chains;
  bool narrow;  // one part of 3 channels per chain, or two on a single chain, held in the records
  const Part<T> *parts;
  int num_parts;
  int64_t channels;  // of all parts
  int64_t padded_channels;
  bool shape_grad[kMaxChains];
  // What backward is for; weights come with shapes. Slots hold nothing of what is not wanted.
  bool shape_grads, weight_grads, value_grads;
  bool used[kMaxChains];  // whether any picture of the chain has a gradient

  const uint32_t *ids;        // [m] row of each rank
  const T *records;           // [m, kRecord]
  const int64_t *tile_begin;  // [tiles + 1] into ranks and masks
  const uint32_t *ranks;
  const uint16_t *masks;

  T *alphas[kMaxChains];          // [height, width] accumulated weight, forward only
  const T *d_alphas[kMaxChains];  // [height, width] or null, backward only
  // Null where no backward pass will follow.
  T *transmittance;   // [tiles, chains, kBlocks, kPixels] after the last contribution
  T *last;            // same shape: place in the tile's list of the last contribution, -1 without
  int64_t slot_size;  // numbers in a slot, backward only
};

// A slot: gradients of one Gaussian from one tile. Moments are sums over pixels of h, the loss's derivative
// by the negative exponent, times u, v, u^2, u v, v^2; a chain's own part of the sum of h is weight times the
// gradient of the weight (csrc/README.md). The channels of the parts follow.
enum Slot {
  kMomentU,
  kMomentV,
  kMomentUU,
  kMomentUV,
  kMomentVV,
  kSlotWeight0,
  kSlotValues = kSlotWeight0 + kMaxChains
};
constexpr int kSlotHead = 8;  // where wide channels begin

// The kernels: what one returns, its name, its arguments; T is float or double. This is the only list: the
// table of an instruction set and the declarations (isa.h) are made of it, and a file defines each once.
//
// project, project_backward: rows [begin, end).
// boxes: the tiles in which the pixel centres of `count` ellipses in a row may lie; empty, x0 >= x1, also
//   where the cutoff is negative. Inverse deviations are brought to octaves by a factor.
// tile_intersect: block masks of one Gaussian over the tiles of a box, row by row.
// rasterize_forward, rasterize_backward: one tile; with scratch as large as its *_scratch says. Backward
//   writes one slot per entry of the tile's list and says whether all it read was finite.
// median_rows: one tile of an image: row of the Gaussian behind which at most half of the first chain's light
//   is left, -1 where more is left behind all.
// cache_weights: weights of the first chain of one tile: entries per block, and if `ids` is given the entries
//   themselves. cached_weights_render: one block of pixels of an image; scratch [channels, kPixels].
//   cached_weights_upstream, cached_weights_backward: the first `count` channels of a block of pixels as
//   [count, kPixels], then the gradient of as many values of one Gaussian over its entries.
// attention, attention_backward: Gaussians [begin, end); backward adds to sums over them, one per lane.
// peak_fma: the fastest that this machine computes: `rounds` times kPeakFmaPacks multiply-adds of 16 lanes,
//   none of which waits for another of its round.
// ssim_*: rows [begin, end), all channels; with scratch as large as the *_scratch of its direction says.
// squared_error_*: pixels [begin, end), few enough for sums in T.
// code_table_pixels: pixels [begin, end); how many of them lack a node.
// mapped_error_pixels: pixels [begin, end). neighbours_backward_row: one row of an image.
// radam_*: numbers [begin, end).
// clang-format off
#define VLGS_KERNELS(KERNEL)                                                                                     \
  KERNEL(void, project, const Camera &, Gaussians<T>, Splats<T>, int64_t begin, int64_t end)                     \
  KERNEL(void, project_backward, const Camera &, Gaussians<T>, GaussianGrads<T>, int64_t begin, int64_t end)     \
  KERNEL(void, boxes, Grid, int64_t count, const T *mean2d, const T *ellipse, T octaves, const T *cutoffs, Box *) \
  KERNEL(void, tile_intersect, Grid, const T *record, T cutoff, Box, uint16_t *masks)                            \
  KERNEL(int64_t, rasterize_forward_scratch, const Pass<T> &, int64_t list_length)                               \
  KERNEL(int64_t, rasterize_backward_scratch, const Pass<T> &, int64_t list_length)                              \
  KERNEL(void, rasterize_forward, const Pass<T> &, int64_t tile, T *scratch, uint32_t *list)                     \
  KERNEL(bool, rasterize_backward, const Pass<T> &, int64_t tile, T *scratch, T *slots)                          \
  KERNEL(void, median_rows, const Pass<T> &, int64_t tile, int64_t *rows)                                        \
  KERNEL(void, cache_weights, const Pass<T> &, int64_t tile, int64_t *counts, uint32_t *ids, T *weights)         \
  KERNEL(void, cached_weights_render, const Grid &, int64_t block, int64_t count, const uint32_t *ids,           \
         const T *weights, const T *values, int64_t channels, T *scratch, T *image)                              \
  KERNEL(void, cached_weights_upstream, const Grid &, int64_t block, const T *d_image, int64_t channels,         \
         int64_t count, T *packs)                                                                                \
  KERNEL(void, cached_weights_backward, int64_t count, const uint32_t *entries, const uint32_t *blocks,          \
         const T *weights, const T *upstream, int64_t channels, T *d_value)                                      \
  KERNEL(int64_t, attention_scratch, const AttentionShape &)                                                     \
  KERNEL(void, attention, const Attention<T> &, Fused<T *> out, int64_t begin, int64_t end, T *scratch)          \
  KERNEL(void, attention_backward, const Attention<T> &, Fused<const T *> d_out, Fused<T *> d_in, int64_t begin, \
         int64_t end, T *scratch, AttentionLayers<T *> sums)                                                     \
  KERNEL(T, peak_fma, int64_t rounds, T factor, T addend)                                                        \
  KERNEL(int64_t, ssim_scratch, const Ssim<T> &)                                                                 \
  KERNEL(void, ssim_map_rows, const Ssim<T> &, T *map, int64_t begin, int64_t end, T *scratch)                   \
  KERNEL(void, ssim_sum_rows, const Ssim<T> &, SsimSums *of_rows, int64_t begin, int64_t end, T *scratch)        \
  KERNEL(int64_t, ssim_backward_scratch, const Ssim<T> &)                                                        \
  KERNEL(void, ssim_backward_rows, const Ssim<T> &, const SsimGrads<T> &, int64_t begin, int64_t end, T *scratch) \
  KERNEL(ErrorSum, squared_error_chunk, const SquaredError<T> &, int64_t begin, int64_t end)                     \
  KERNEL(void, squared_error_chunk_backward, const SquaredError<T> &, T scale, T *d_a, int64_t begin, int64_t end)\
  KERNEL(int64_t, code_table_pixels, const CodeTable<T> &, int64_t begin, int64_t end)                           \
  KERNEL(void, radam_moments_of, const RAdamMoments<T> &, int64_t begin, int64_t end)                            \
  KERNEL(double, mapped_error_pixels, const MappedError<T> &, int64_t begin, int64_t end)                        \
  KERNEL(void, neighbours_backward_row, const Neighbours<T> &, int64_t y)                                        \
  KERNEL(void, radam_weights_of, const RAdamWeights<T> &, int64_t begin, int64_t end)
// clang-format on

template <class T>
struct Kernels {
#define VLGS_POINTER(result, name, ...) result (*name)(__VA_ARGS__);
  VLGS_KERNELS(VLGS_POINTER)
#undef VLGS_POINTER
};

// The set in use: "v4" (AVX-512), "v3" (AVX2 and FMA) or "base"; VLGS_ISA lowers it.
const char *isa();
// Those of this build that run here, best first, with blanks between.
const char *isas();
template <class T>
const Kernels<T> &kernels();

}  // namespace vlgs
