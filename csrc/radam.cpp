#include "radam.h"

#include <cmath>

#include "isa.h"

// The compiler makes vectors of these. Where torch rounds once so do they, also on machines without such an
// instruction.
namespace vlgs::VLGS_ISA_NS {

void radam_moments_of(const RAdamMoments<T> &r, int64_t begin, int64_t end) {
  const T *__restrict weight = r.weight, *__restrict gradient = r.gradient;
  T *__restrict mean = r.mean, *__restrict square = r.square;
  for (int64_t i = begin; i < end; ++i) {
    const T g = std::fma(weight[i], r.decay, gradient[i]);
    mean[i] = std::fma(r.to_mean, g - mean[i], mean[i]);
    square[i] = std::fma(r.to_square * g, g, square[i] * r.kept);
  }
}

void radam_weights_of(const RAdamWeights<T> &r, int64_t begin, int64_t end) {
  const T *__restrict mean = r.mean, *__restrict root = r.root;
  T *__restrict weight = r.weight;
  for (int64_t i = begin; i < end; ++i) {
    const T step = mean[i] / r.bias * r.rate;
    weight[i] -= root ? step * (1 / (root[i] + r.eps) * r.scale) * r.rectified : step;
  }
}

}  // namespace vlgs::VLGS_ISA_NS
