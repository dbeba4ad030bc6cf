// Rows of numbers, channels side by side, stream through: of p and q the kTaps rows around the row at hand
// are kept, in a ring. The window goes down the columns of a ring into a line, and then along that line.
#include "ssim.h"

#include <cstring>
#include <type_traits>

#include "isa.h"
#include "simd.h"
#include "stretches.h"

namespace vlgs::VLGS_ISA_NS {
namespace {

constexpr int64_t kHalf = kTaps / 2;
constexpr int kMoments = 4;  // of p, q, p^2, q^2
constexpr int kSlopes = 4;   // by p^2, by q^2, and by the means as a has them and as b has them

int64_t rounded(int64_t numbers) { return (numbers + kLanes - 1) / kLanes * kLanes; }

// Numbers in a line: a row of whole packs, and what the window reaches beyond either end.
template <class T>
int64_t line_size(const Ssim<T> &s) {
  return rounded(s.numbers()) + 2 * kHalf * s.channels;
}

// The last kTaps rows of something, padded with zeros to whole packs.
template <class T>
struct Ring {
  T *rows;
  int64_t size;  // of a row

  T *row(int64_t y) const { return rows + y % kTaps * size; }
};

// What the window covers: a place in each of kTaps rows, or kTaps places of one line.
template <class T>
struct Covered {
  const T *from[kTaps];
};

template <class T>
struct Taps {
  Pack<T> tap[kTaps];
};

template <class T>
VLGS_INLINE Pack<T> windowed(const Taps<T> &taps, const Covered<T> &covered, int64_t x) {
  Pack<T> sum = splat(T(0));
  for (int k = 0; k < kTaps; ++k) sum = sum + taps.tap[k] * load(covered.from[k] + x);
  return sum;
}

// Of the numbers and of their squares.
template <class T>
VLGS_INLINE void windowed_squares(const Taps<T> &taps, const Covered<T> &covered, int64_t x, T *sums,
                                  T *squares) {
  Pack<T> sum = splat(T(0)), square = sum;
  for (int k = 0; k < kTaps; ++k) {
    const Pack<T> number = load(covered.from[k] + x);
    sum = sum + taps.tap[k] * number;
    square = square + taps.tap[k] * (number * number);
  }
  store(sums + x, sum);
  store(squares + x, square);
}

template <class T>
VLGS_INLINE Pack<T> not_negative(const Pack<T> &x) {  // NaN stays NaN
  const Pack<T> zero = splat(T(0));
  return select(x < zero, zero, x);
}
template <class T>
VLGS_INLINE Pack<T> operator/(Pack<T> a, const Pack<T> &b) {
  VLGS_FOR_PARTS a.part[i] /= b.part[i];
  return a;
}

template <class T>
struct Moments {
  Pack<T> p, q, p2, q2;        // means, and their squares
  Pack<T> rough_var_p, var_p;  // variances as they come out, and clamped at 0
  Pack<T> rough_var_q, var_q;
};

// A band of rows on its way through.
template <class T>
struct Stream {
  const Ssim<T> &s;
  int64_t size = rounded(s.numbers()), line = line_size(s);
  Taps<T> taps;
  T *zeros;            // [size]
  T *lines[kMoments];  // [line] each
  Ring<T> p, q;
  int64_t next;  // row to read

  Stream(const Ssim<T> &given, int64_t first, T *scratch) : s(given) {
    std::memset(scratch, 0, size_t(scratch_size(s)) * sizeof(T));
    for (int k = 0; k < kTaps; ++k) taps.tap[k] = splat(s.taps[k]);
    zeros = scratch;
    for (int m = 0; m < kMoments; ++m) lines[m] = zeros + size + m * line;
    p = {lines[0] + kMoments * line, size};
    q = {p.rows + kTaps * size, size};
    next = first < kHalf ? 0 : first - kHalf;
  }
  static int64_t scratch_size(const Ssim<T> &s) {
    return rounded(s.numbers()) * (1 + 2 * kTaps) + kMoments * line_size(s);
  }

  // Up to what the window covers around row y.
  void read_around(int64_t y) {
    for (; next < s.height && next <= y + kHalf; ++next) {
      const T *a = s.a + next * s.numbers(), *b = s.b + next * s.numbers();
      T *const to_p = p.row(next), *const to_q = q.row(next);
      for_stretches(row_of_mask(next), 0, s.width, [&](int64_t first, int64_t last, bool counts) {
        read(a, b, counts, first * s.channels, last * s.channels, to_p, to_q);
      });
    }
  }
  static void read(const T *a, const T *b, bool counts, int64_t begin, int64_t end, T *__restrict to_p,
                   T *__restrict to_q) {
    if (counts)
      for (int64_t i = begin; i < end; ++i) to_p[i] = a[i] + b[i], to_q[i] = a[i] - b[i];
    else
      for (int64_t i = begin; i < end; ++i) to_p[i] = to_q[i] = 0;
  }
  const bool *row_of_mask(int64_t y) const { return s.valid ? s.valid + y * s.width : nullptr; }

  // The pixels of row y that count get a value, others 0; returns how many do.
  int64_t fill(T *row, int64_t y, T value) const {
    int64_t pixels = 0;
    for_stretches(row_of_mask(y), 0, s.width, [&](int64_t first, int64_t last, bool counts) {
      const T filled = counts ? value : T(0);
      for (int64_t i = first * s.channels; i < last * s.channels; ++i) row[i] = filled;
      pixels += counts ? last - first : 0;
    });
    return pixels;
  }

  Covered<T> around(const Ring<T> &ring, int64_t y) const {
    Covered<T> covered;
    for (int64_t k = 0, at = y - kHalf; k < kTaps; ++k, ++at)
      covered.from[k] = at >= 0 && at < s.height ? ring.row(at) : zeros;
    return covered;
  }
  Covered<T> along(const T *of_line) const {
    Covered<T> covered;
    for (int64_t k = 0; k < kTaps; ++k) covered.from[k] = of_line + k * s.channels;
    return covered;
  }
  T *middle(T *of_line) const { return of_line + kHalf * s.channels; }

  // Calls with x and the moments of every pack of row y, around which all has been read.
  template <class Call>
  VLGS_INLINE void for_moments(int64_t y, Call call) const {
    T *to[kMoments];
    for (int m = 0; m < kMoments; ++m) to[m] = middle(lines[m]);
    const Covered<T> rows_p = around(p, y), rows_q = around(q, y);
    for (int64_t x = 0; x < size; x += kLanes) windowed_squares(taps, rows_p, x, to[0], to[2]);
    for (int64_t x = 0; x < size; x += kLanes) windowed_squares(taps, rows_q, x, to[1], to[3]);
    const Covered<T> p_line = along(lines[0]), q_line = along(lines[1]);
    const Covered<T> pp_line = along(lines[2]), qq_line = along(lines[3]);
    for (int64_t x = 0; x < size; x += kLanes) {
      Moments<T> m;
      m.p = windowed(taps, p_line, x), m.q = windowed(taps, q_line, x);
      m.p2 = m.p * m.p, m.q2 = m.q * m.q;
      m.rough_var_p = windowed(taps, pp_line, x) - m.p2;
      m.rough_var_q = windowed(taps, qq_line, x) - m.q2;
      m.var_p = not_negative(m.rough_var_p), m.var_q = not_negative(m.rough_var_q);
      call(x, m);
    }
  }
};

template <class T>
VLGS_INLINE Pack<T> similarity(const Moments<T> &m, const Pack<T> &luminance_floor,
                               const Pack<T> &structure_floor) {
  const Pack<T> luminance = (m.p2 - m.q2 + luminance_floor) / (m.p2 + m.q2 + luminance_floor);
  return luminance * ((m.var_p - m.var_q + structure_floor) / (m.var_p + m.var_q + structure_floor));
}

template <class T>
VLGS_INLINE Pack<T> magnitude(const Pack<T> &x) {
  const Pack<T> zero = splat(T(0));
  return select(x < zero, zero - x, x);
}
template <class T>
VLGS_INLINE double sum_of(const Pack<T> &pack) {
  T lanes[kLanes];
  store(lanes, pack);
  double sum = 0;
  for (const T lane : lanes) sum += double(lane);
  return sum;
}

// What of a pack lies within a row.
template <class T>
VLGS_INLINE void put(T *row, int64_t x, int64_t numbers, const Pack<T> &pack) {
  if (x + kLanes <= numbers) return store(row + x, pack);
  T lanes[kLanes];
  store(lanes, pack);
  std::memcpy(row + x, lanes, size_t(numbers - x) * sizeof(T));
}

// One channel out of a row. The step is a constant where it can be: GCC then vectorises the loop.
template <class T, class Step>
void pick(const T *from, Step step, int64_t width, T *__restrict to) {
  for (int64_t x = 0; x < width; ++x) to[x] = from[x * step];
}

}  // namespace

int64_t ssim_scratch(const Ssim<T> &s) { return Stream<T>::scratch_size(s) + rounded(s.numbers()); }

void ssim_map_rows(const Ssim<T> &s, T *map, int64_t begin, int64_t end, T *scratch) {
  Stream<T> stream(s, begin, scratch);
  T *const row = scratch + Stream<T>::scratch_size(s);
  const Pack<T> luminance_floor = splat(s.luminance_floor), structure_floor = splat(s.structure_floor);
  for (int64_t y = begin; y < end; ++y) {
    stream.read_around(y);
    stream.for_moments(y, [&](int64_t x, const Moments<T> &m) {
      store(row + x, similarity(m, luminance_floor, structure_floor));
    });
    for (int64_t c = 0; c < s.channels; ++c) {
      T *const to = map + (c * s.height + y) * s.width;
      if (s.channels == 3)
        pick(row + c, std::integral_constant<int64_t, 3>(), s.width, to);
      else
        pick(row + c, s.channels, s.width, to);
    }
  }
}

void ssim_sum_rows(const Ssim<T> &s, SsimSums *sums, int64_t begin, int64_t end, T *scratch) {
  Stream<T> stream(s, begin, scratch);
  T *const counts = scratch + Stream<T>::scratch_size(s);  // 1 or 0
  std::memset(counts, 0, size_t(stream.size) * sizeof(T));
  const Pack<T> luminance_floor = splat(s.luminance_floor), structure_floor = splat(s.structure_floor);
  const Pack<T> one = splat(T(1));
  for (int64_t y = begin; y < end; ++y) {
    stream.read_around(y);
    const int64_t pixels = stream.fill(counts, y, 1);
    const T *const q = stream.q.row(y);
    Pack<T> distance = splat(T(0)), dissimilarity = distance;
    stream.for_moments(y, [&](int64_t x, const Moments<T> &m) {
      distance = distance + magnitude(load(q + x));
      dissimilarity =
          dissimilarity + load(counts + x) * (one - similarity(m, luminance_floor, structure_floor));
    });
    sums[y] = {sum_of(distance), sum_of(dissimilarity), pixels};
  }
}

int64_t ssim_backward_scratch(const Ssim<T> &s) {
  return Stream<T>::scratch_size(s) + kSlopes * line_size(s) + (1 + kSlopes * kTaps) * rounded(s.numbers());
}

// With the windowed moments P, Q, PP, QQ of a pixel and the variances V = PP - P^2, W = QQ - Q^2, the value
// is luminance times structure, and its derivatives, times the gradient that comes in, are
//   by PP, twice:  4 luminance W / (V + W + floor)^2, and 0 where V is clamped;
//   by QQ, twice: -4 luminance (V + floor) / (V + W + floor)^2, and 0 where W is clamped;
//   by P:  P ( 4 structure Q^2 / (P^2 + Q^2 + floor)^2 - twice the one by PP);
//   by Q:  Q (-4 structure (P^2 + floor) / (P^2 + Q^2 + floor)^2 - twice the one by QQ).
// Those by PP and QQ come back through the window (its own transpose) and p and q, those by P and Q through
// the window alone. The gradients by a and b are the sum and the difference of those by p and q.
void ssim_backward_rows(const Ssim<T> &s, const SsimGrads<T> &d, int64_t begin, int64_t end, T *scratch) {
  const int64_t first = begin < kHalf ? 0 : begin - kHalf, numbers = s.numbers();
  Stream<T> stream(s, first, scratch);
  const int64_t size = stream.size, line = stream.line;
  T *const lines = scratch + Stream<T>::scratch_size(s), *const d_row = lines + kSlopes * line;
  Ring<T> slopes[kSlopes];
  for (int m = 0; m < kSlopes; ++m) slopes[m] = {d_row + size + m * kTaps * size, size};
  std::memset(lines, 0, size_t(kSlopes * line + size) * sizeof(T));
  const int used = d.d_b ? kSlopes : kSlopes - 1;
  const Pack<T> luminance_floor = splat(s.luminance_floor), structure_floor = splat(s.structure_floor);
  const Pack<T> zero = splat(T(0)), one = splat(T(1)), d_distance = splat(d.d_distance);
  for (int64_t t = first; t < end + kHalf; ++t) {
    if (t < s.height) {
      stream.read_around(t);
      if (d.d_map)
        for (int64_t i = 0; i < numbers; ++i) d_row[i] = 4 * d.d_map[t * numbers + i];
      else
        stream.fill(d_row, t, 4 * d.d_value);
      T *const to[kSlopes] = {slopes[0].row(t), slopes[1].row(t), slopes[2].row(t), slopes[3].row(t)};
      stream.for_moments(t, [&](int64_t x, const Moments<T> &m) {
        const Pack<T> by_means = one / (m.p2 + m.q2 + luminance_floor);
        const Pack<T> by_vars = one / (m.var_p + m.var_q + structure_floor);
        const Pack<T> luminance = (m.p2 - m.q2 + luminance_floor) * by_means;
        const Pack<T> structure = (m.var_p - m.var_q + structure_floor) * by_vars;
        const Pack<T> d_out = load(d_row + x);
        const Pack<T> d_structure = d_out * luminance * by_vars, d_luminance = d_out * structure * by_means;
        const Pack<T> pp = d_structure * (m.var_q * by_vars);
        const Pack<T> qq = zero - d_structure * ((m.var_p + structure_floor) * by_vars);
        const Pack<T> by_pp = select(m.rough_var_p < zero, zero, pp);
        const Pack<T> by_qq = select(m.rough_var_q < zero, zero, qq);
        const Pack<T> by_p = m.p * (d_luminance * (m.q2 * by_means) - by_pp);
        const Pack<T> by_q = m.q * (zero - d_luminance * ((m.p2 + luminance_floor) * by_means) - by_qq);
        store(to[0] + x, by_pp);
        store(to[1] + x, by_qq);
        store(to[2] + x, by_p + by_q);
        store(to[3] + x, by_p - by_q);
      });
    }
    const int64_t y = t - kHalf;
    if (y < begin) continue;
    Covered<T> along[kSlopes];
    for (int m = 0; m < used; ++m) {
      const Covered<T> rows = stream.around(slopes[m], y);
      T *const to = stream.middle(lines + m * line);
      for (int64_t x = 0; x < size; x += kLanes) store(to + x, windowed(stream.taps, rows, x));
      along[m] = stream.along(lines + m * line);
    }
    const T *const p = stream.p.row(y), *const q = stream.q.row(y);
    T *const to_a = d.d_a + y * numbers, *const to_b = d.d_b ? d.d_b + y * numbers : nullptr;
    for (int64_t x = 0; x < size; x += kLanes) {
      const Pack<T> gap = load(q + x);
      const Pack<T> sign = select(gap < zero, zero - d_distance, select(zero < gap, d_distance, gap));
      const Pack<T> by_p = load(p + x) * windowed(stream.taps, along[0], x);
      const Pack<T> by_q = gap * windowed(stream.taps, along[1], x) + sign;
      put(to_a, x, numbers, windowed(stream.taps, along[2], x) + by_p + by_q);
      if (to_b) put(to_b, x, numbers, windowed(stream.taps, along[3], x) + by_p - by_q);
    }
    for_stretches(stream.row_of_mask(y), 0, s.width, [&](int64_t from, int64_t to, bool counts) {
      if (counts) return;
      const size_t bytes = size_t((to - from) * s.channels) * sizeof(T);
      std::memset(to_a + from * s.channels, 0, bytes);
      if (to_b) std::memset(to_b + from * s.channels, 0, bytes);
    });
  }
}

}  // namespace vlgs::VLGS_ISA_NS
