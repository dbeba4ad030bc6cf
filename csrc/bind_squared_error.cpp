// Sum of squared differences of two images, and back.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include <optional>

#include "bindings.h"
#include "squared_error.h"

namespace vlgs {
namespace {

template <class T>
void bind_squared_error_of(nb::module_ &m) {
  using Valid = std::optional<Array<const bool, -1, -1>>;
  const auto make = [](const Image<const T> &a, const Image<const T> &b, const Valid &valid) {
    return SquaredError<T>{int64_t(a.shape(0) * a.shape(1)), int64_t(a.shape(2)), a.data(), b.data(),
                           valid ? valid->data() : nullptr};
  };
  m.def(
      "squared_error",
      [make](Image<const T> a, Image<const T> b, Valid valid, int threads) {
        const auto e = make(a, b, valid);
        nb::gil_scoped_release unlocked;
        const ErrorSum total = squared_error<T>(e, threads);
        return std::pair(total.sum, total.pixels);
      },
      strict("a"), strict("b"), strict("valid").none(), "threads"_a);
  m.def(
      "squared_error_backward",
      [make](Image<const T> a, Image<const T> b, Valid valid, double scale, Image<T> d_a, int threads) {
        const auto e = make(a, b, valid);
        nb::gil_scoped_release unlocked;
        squared_error_backward<T>(e, T(scale), d_a.data(), threads);
      },
      strict("a"), strict("b"), strict("valid").none(), "scale"_a, strict("d_a"), "threads"_a);
}

}  // namespace

void bind_squared_error(nb::module_ &m) {
  bind_squared_error_of<float>(m);
  bind_squared_error_of<double>(m);
}

}  // namespace vlgs
