// Finds the tiles that a Gaussian may reach, and the 4x4 blocks in them that it does reach. In each row of
// pixels, the centres inside of its ellipse are an interval.
#include "isa.h"
#include "simd.h"

namespace vlgs::VLGS_ISA_NS {
namespace {

constexpr int32_t kNever = 1 << 28;
constexpr int kColumns = kTile / kBlock;

// Four block rows of a tile, one per lane.
typedef int32_t Quad __attribute__((vector_size(16)));
inline Quad quad(int32_t x) { return Quad{x, x, x, x}; }
inline Quad smaller(Quad a, Quad b) { return a < b ? a : b; }
inline Quad larger(Quad a, Quad b) { return a > b ? a : b; }

// Block columns [first, last) that their pixels reach, counted from the first tile; none is [kNever, 0).
struct BlockRows {
  Quad first, last;
};

inline float root(float x) { return __builtin_sqrtf(x); }
inline double root(double x) { return __builtin_sqrt(x); }

// An ellipse with the box of tiles it is looked for in, widened by what rounding may take away here or in the
// blending, so that no pixel is missed.
template <class T>
struct Ellipse {
  T mean_y, slope, inv_sigma_y, sigma_x, cutoff;
  T middle;   // mean_x in pixel columns from the first tile
  T slack;    // pixels
  T columns;  // pixel columns of the box within the image
  int32_t height;
};

template <class T>
inline Ellipse<T> ellipse(const Grid &grid, const T *g, T cutoff, const Box &box) {
  constexpr T kEpsilon = sizeof(T) == 4 ? T(1.2e-7) : T(2.3e-16);
  const int32_t x0 = box.x0 * kTile, y0 = box.y0 * kTile;
  const int32_t right = box.x1 * kTile < grid.width ? box.x1 * kTile : int32_t(grid.width);
  Ellipse<T> e;
  e.mean_y = g[kMeanY], e.slope = g[kSlope], e.inv_sigma_y = g[kInvSigmaY], e.sigma_x = 1 / g[kInvSigmaX];
  e.middle = (g[kMeanX] - T(x0)) - T(0.5);
  e.columns = T(right - x0);
  e.height = int32_t(grid.height);
  e.cutoff = cutoff * (1 + 16 * kEpsilon);
  const T rise = e.slope * T(box.y1 * kTile - y0);
  e.slack = 8 * kEpsilon * ((rise < 0 ? -rise : rise) + e.columns + kTile);
  return e;
}

template <class T>
inline BlockRows block_rows(const Ellipse<T> &e, int32_t y0) {
  int32_t first[kTile], last[kTile];
  for (int i = 0; i < kTile; ++i) {
    const int32_t y = y0 + i % 4 * kBlock + i / 4;  // rows of one block four apart, to be folded as vectors
    const T dy = (T(y) + T(0.5)) - e.mean_y, v = e.inv_sigma_y * dy, rest = e.cutoff - v * v;
    const T half = root(rest > 0 ? rest : T(0)) * e.sigma_x + e.slack, middle = e.middle + e.slope * dy;
    T low = middle - half, high = middle + half;
    low = low > 0 ? low : T(0);
    low = low < e.columns ? low : e.columns;
    high = high < e.columns - 1 ? high : e.columns - 1;
    high = high > -1 ? high : T(-1);
    const int32_t floor_low = int32_t(low), from = floor_low + (T(floor_low) < low);
    const int32_t to = int32_t(high + 1);  // one beyond the last, as high >= -1
    const bool hit = (rest >= 0) & (from < to) & (y < e.height);
    first[i] = hit ? from >> 2 : kNever;
    last[i] = hit ? (to + kBlock - 1) >> 2 : 0;
  }
  Quad f[kBlock], l[kBlock];
  std::memcpy(f, first, sizeof f);
  std::memcpy(l, last, sizeof l);
  return {smaller(smaller(f[0], f[1]), smaller(f[2], f[3])), larger(larger(l[0], l[1]), larger(l[2], l[3]))};
}

inline uint16_t mask_of(const BlockRows &rows, int32_t column) {
  const Quad none = {}, one = quad(1), all = quad(kColumns);
  const Quad a = smaller(larger(rows.first - column, none), all);
  const Quad b = larger(smaller(rows.last - column, all), a);
  const Quad bits = ((one << b) - (one << a)) << Quad{0, kColumns, 2 * kColumns, 3 * kColumns};
  return uint16_t(bits[0] | bits[1] | bits[2] | bits[3]);
}

inline double smaller(double a, double b) { return a < b ? a : b; }
inline double larger(double a, double b) { return a > b ? a : b; }

}  // namespace

// In double, and the same bits on every instruction set. Loops over kLanes become vector code.
void boxes(Grid grid, int64_t count, const T *mean2d, const T *ellipse, T octaves, const T *cutoffs,
           Box *out) {
  const double width = double(grid.width), height = double(grid.height);
  for (int64_t first = 0; first < count; first += kLanes) {
    const int64_t some = count - first < kLanes ? count - first : kLanes;
    double mean_x[kLanes], mean_y[kLanes], inv_x[kLanes], slope[kLanes], inv_y[kLanes], cutoff[kLanes];
    for (int l = 0; l < kLanes; ++l) {
      const int64_t i = first + (l < some ? l : some - 1);
      mean_x[l] = mean2d[2 * i], mean_y[l] = mean2d[2 * i + 1];
      inv_x[l] = ellipse[3 * i] * octaves, slope[l] = ellipse[3 * i + 1];
      inv_y[l] = ellipse[3 * i + 2] * octaves;
      cutoff[l] = cutoffs[i];
    }
    int32_t x0[kLanes], y0[kLanes], x1[kLanes], y1[kLanes];
    for (int l = 0; l < kLanes; ++l) {
      const double reach = root(cutoff[l] > 0 ? cutoff[l] : 0), sigma_x = 1 / inv_x[l],
                   sigma_y = 1 / inv_y[l];
      const double skew = slope[l] * sigma_y;
      const double half_x = reach * root(sigma_x * sigma_x + skew * skew) * (1 + 1e-5) + 1e-3;
      const double half_y = reach * sigma_y * (1 + 1e-5) + 1e-3;
      // Pixels from the one whose centre may lie just inside to one beyond the last; truncation is floor from
      // 0 on.
      const double left = larger(mean_x[l] - half_x + 0.5, 0),
                   right = smaller(mean_x[l] + half_x + 0.5, width);
      const double top = larger(mean_y[l] - half_y + 0.5, 0),
                   bottom = smaller(mean_y[l] + half_y + 0.5, height);
      const bool hit = (cutoff[l] >= 0) & (left < right) & (top < bottom);
      x0[l] = int32_t(hit ? left : 0) / kTile, x1[l] = (int32_t(hit ? right : 0) + kTile - 1) / kTile;
      y0[l] = int32_t(hit ? top : 0) / kTile, y1[l] = (int32_t(hit ? bottom : 0) + kTile - 1) / kTile;
    }
    for (int l = 0; l < some; ++l) out[first + l] = {x0[l], y0[l], x1[l], y1[l]};
  }
}

void tile_intersect(Grid grid, const T *record, T cutoff, Box box, uint16_t *masks) {
  const Ellipse<T> e = ellipse(grid, record, cutoff, box);
  for (int32_t y = box.y0; y < box.y1; ++y) {
    const BlockRows rows = block_rows(e, y * kTile);
    for (int32_t x = box.x0; x < box.x1; ++x) *masks++ = mask_of(rows, (x - box.x0) * kColumns);
  }
}

}  // namespace vlgs::VLGS_ISA_NS
