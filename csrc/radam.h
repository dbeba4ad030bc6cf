// A step of RAdam (Liu et al., ICLR 2020): of a dozen passes over a table, all but the square roots in two.
#pragma once

#include <cstdint>

namespace vlgs {

// What is the same for all numbers is rounded to T once, and every operation to T after it, as those of
// torch.optim.RAdam.
template <class T>
struct RAdamMoments {
  int64_t count;
  const T *weight, *gradient;  // [count]
  T *mean, *square;            // [count] moving averages of the gradient and of its square
  T decay;                     // of weights, added to the gradient
  T to_mean, kept, to_square;  // shares: of the gradient in the mean, of the old and of the new square
};
template <class T>
struct RAdamWeights {
  int64_t count;
  const T *mean;
  const T *root;  // [count] of the squares; null in the first steps, as they do not say enough yet
  T *weight;
  T bias, rate;             // what the mean is divided by and multiplied with
  T eps, scale, rectified;  // and then with scale / (root + eps), and with the last
};

template <class T>
void radam_moments(const RAdamMoments<T> &, int threads);
template <class T>
void radam_weights(const RAdamWeights<T> &, int threads);

}  // namespace vlgs
