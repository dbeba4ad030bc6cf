// The operations the bindings offer: threads and memory around the kernels.
#pragma once

#include <string>
#include <vector>

#include "binning.h"

namespace vlgs {

// Both throw std::invalid_argument naming the first number that is not finite.
template <class T>
void project(const Camera &, int64_t n, const Gaussians<T> &, const Splats<T> &, int threads);
template <class T>
void project_backward(const Camera &, int64_t n, const Gaussians<T> &, const GaussianGrads<T> &, int threads);

struct RasterizeConfig {
  double alpha_min, alpha_max, transmittance_min;
  bool stop_before;
  int64_t memory_budget;  // bytes
  Trim trim;
};

template <class T>
struct Chain {
  const T *weight;  // [n]
  bool shape_grad;
  T *alpha;   // [height, width]
  int group;  // for messages
};

template <class T>
struct RasterizeGrads {
  std::vector<const T *> values;    // [n, channels] per part, as they were
  std::vector<const T *> d_images;  // per part; null where unused
  std::vector<const T *> d_alphas;  // per chain; null where unused
  // Written; null where it is not wanted, and then no work goes into it.
  T *d_mean2d, *d_ellipse;     // [n, 2], [n, 3]
  std::vector<T *> d_weights;  // [n] per chain
  std::vector<T *> d_values;   // [n, channels] per part
};

// What a forward pass took, for benchmarks.
struct RasterizeWork {
  int64_t entries;  // of all tile lists
  int64_t weighed;  // (Gaussian, 4x4 block, chain) triples that blending went through
};

// One picture: blends on construction and keeps the lists for its gradients.
template <class T>
class Rasterized {
 public:
  // `parts` are in the order of their chains. Without `keep` there is no backward pass.
  Rasterized(const Grid &, int64_t n, const Splats<T> &, std::vector<Chain<T>>, std::vector<Part<T>> parts,
             const RasterizeConfig &, bool keep, bool *visible, int threads);

  void backward(const RasterizeGrads<T> &, int threads) const;

  // [height, width]: the Gaussian behind which at most half of the first chain's light is left, -1 where more
  // is left behind all; needs `keep`.
  void median_rows(int64_t *rows, int threads) const;

  // Counted afterwards, from the lists and what is kept for backward: needs `keep` and not `stop_before`.
  RasterizeWork work() const;

  int64_t rows() const { return n_; }
  const Pass<T> &pass() const { return stages_[0].pass; }  // of the first chains; valid while this lives

 private:
  // Chains [first_chain, first_chain + pass.chains) and their parts.
  struct Stage {
    Pass<T> pass;
    std::vector<Part<T>> parts;
    int first_chain, first_part;
    Buffer<T> records, transmittance, last;
  };
  Stage make_stage(int first_chain, int num_chains) const;
  void fill_records(Stage &, const Splats<T> &, int threads) const;
  void check_memory(const Pass<T> &) const;
  void render(Stage &, bool keep, int threads) const;
  Buffer<T> sum_slots(const Pass<T> &, T *const *d_values, int threads) const;
  void write_gradients(const Stage &, const Pass<T> &, const Buffer<T> &sums, const RasterizeGrads<T> &,
                       int threads) const;

  int64_t n_;
  Grid grid_;
  RasterizeConfig config_;
  std::vector<Chain<T>> chains_;
  std::vector<Part<T>> parts_;
  DepthOrder<T> order_;
  TileLists lists_;
  std::vector<Stage> stages_;
};

}  // namespace vlgs
