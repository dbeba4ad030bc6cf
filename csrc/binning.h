// From splats to tile lists: cull, sort by (depth, row), and write each Gaussian into the list of every tile
// it reaches.
#pragma once

#include <cstdint>
#include <vector>

#include "buffer_pool.h"
#include "kernels.h"
#include "threads.h"

namespace vlgs {

constexpr uint32_t kCulled = UINT32_MAX;

// The Gaussians that may reach a pixel, by (depth, row): their place in that order is their rank.
template <class T>
struct DepthOrder {
  int64_t count = 0;         // m
  Buffer<uint32_t> ids;      // [m] row of each rank
  Buffer<uint32_t> rank_of;  // [n] or kCulled
  Buffer<T>
      cutoffs;  // [chains, n] largest exponent at which alpha_min is reached, negative where it never is
  Buffer<Box> boxes;  // [n] for the largest of them
};

// What is left out of the lists; without, they are longer and the pictures the same.
struct Trim {
  bool tile_test;       // tiles of the box that the ellipse misses
  bool block_masks;     // blocks of a tile that it misses
  bool opacity_extent;  // what lies beyond alpha_min for this weight, rather than for a weight of 1
};

// Throws std::invalid_argument naming a weight that is not in [0, 1].
template <class T>
DepthOrder<T> sort_visible(const Grid &, int64_t n, const Splats<T> &, const std::vector<const T *> &weights,
                           T alpha_min, int threads);

struct TileLists {
  std::vector<int64_t> begin;  // [tiles + 1]
  int64_t longest = 0;         // list
  Buffer<uint32_t> ranks;      // [begin.back()] front to back within a tile
  Buffer<uint16_t> masks;      // blocks of the tile that the Gaussian reaches
};

// `records` [m, kRecord] hold the geometry. Sets visible[i] of the rows that reach a pixel above alpha_min in
// any chain. Throws std::invalid_argument if the lists would take more than `budget` bytes.
template <class T>
TileLists bin_gaussians(const Grid &, int64_t n, const DepthOrder<T> &, const T *records, int chains,
                        T alpha_min, const Trim &, int64_t budget, bool *visible, int threads);

}  // namespace vlgs
