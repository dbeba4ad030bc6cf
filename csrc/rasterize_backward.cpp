// The backward pass of blending. A tile's Gaussians are visited back to front; for each of them, all 4x4
// blocks of the tile that it reaches. Its gradients are summed in registers and stored once per tile.
// csrc/README.md derives the formulas.
#include "alpha.h"

namespace vlgs::VLGS_ISA_NS {
namespace {

// What is kept of a block, in packs.
enum State { kCentreX, kCentreY, kChainState };
enum ChainState {
  kLast,           // place of the last contribution
  kTransmittance,  // behind the Gaussian at hand
  kBehind,         // what lies behind, as seen from the Gaussian at hand, in the direction of the gradient
  kAlphaT,         // a T of the Gaussian at hand
  kChainStates
};
constexpr int64_t state_size(int chains) { return (kChainState + chains * kChainStates) * kLanes; }

template <class T>
struct Tile {
  const Pass<T> *pass;
  int64_t index, begin, count;
  const T *records;
  T *upstream;  // [kBlocks, padded channels + chains, kLanes]: gradients of the images, then of the alphas
  int64_t upstream_stride;
  T *state;  // [kBlocks, state_size]
  T alpha_max;
};

// Blocks whose last contribution lies at or behind a place, updated while the place moves forward.
struct Live {
  int order[kBlocks];
  int64_t last[kBlocks];
  int next = 0;
  uint32_t bits = 0;

  uint32_t at(int64_t place) {
    while (next < kBlocks && last[order[next]] >= place) bits |= 1u << order[next++];
    return bits;
  }
};

template <class T>
Live live_blocks(const Tile<T> &tile) {
  Live live;
  for (int b = 0; b < kBlocks; ++b) {
    live.last[b] = -1;
    for (int c = 0; c < tile.pass->chains; ++c)
      for (int l = 0; l < kLanes; ++l) {
        const T last = tile.state[b * state_size(tile.pass->chains) +
                                  (kChainState + c * kChainStates + kLast) * kLanes + l];
        if (last > T(live.last[b])) live.last[b] = int64_t(last);
      }
    int i = b;
    for (; i > 0 && live.last[live.order[i - 1]] < live.last[b]; --i) live.order[i] = live.order[i - 1];
    live.order[i] = b;
  }
  return live;
}

// Pixels of one block to lanes: channels of an image [height, width, channels] become packs. Lanes beyond the
// image stay as they are.
template <class T>
inline void to_lanes(const Grid &grid, const T *image, int64_t channels, int64_t x0, int64_t y0, T *packs) {
  const int64_t columns = grid.width - x0 < kBlock ? grid.width - x0 : kBlock;
  for (int row = 0; row < kBlock && y0 + row < grid.height && columns > 0; ++row, packs += kBlock) {
    const T *from = image + ((y0 + row) * grid.width + x0) * channels;
    if (channels == 3 && columns == kBlock)
      pixels_to_lanes(from, packs);
    else
      for (int64_t x = 0; x < columns; ++x)
        for (int64_t k = 0; k < channels; ++k) packs[k * kLanes + x] = from[x * channels + k];
  }
}

// Gradients of the images of a tile; false if any is not finite.
template <class T>
bool load_upstream(const Tile<T> &tile) {
  const Pass<T> &p = *tile.pass;
  const int64_t size = kBlocks * tile.upstream_stride;
  for (int64_t i = 0; i < size; ++i) tile.upstream[i] = 0;
  for (int b = 0; b < kBlocks; ++b) {
    const int64_t x0 = tile.index % p.grid.tiles_x * kTile + b % 4 * kBlock;
    const int64_t y0 = tile.index / p.grid.tiles_x * kTile + b / 4 * kBlock;
    T *to = tile.upstream + b * tile.upstream_stride;
    for (int i = 0; i < p.num_parts; to += p.parts[i++].padded * kLanes)
      if (p.parts[i].d_image) to_lanes(p.grid, p.parts[i].d_image, p.parts[i].channels, x0, y0, to);
    for (int c = 0; c < p.chains; ++c, to += kLanes)
      if (p.d_alphas[c]) to_lanes(p.grid, p.d_alphas[c], 1, x0, y0, to);
  }
  Mask<T> finite = ~Mask<T>{};
  for (int64_t i = 0; i < size; i += kLanes)
    finite = finite & (load(tile.upstream + i) * splat(T(0)) <= splat(T(0)));
  return !any(~finite);
}

// What one Gaussian collects over its blocks.
template <class T, int kChains>
struct Sums {
  Pack<T> moment[5], weight[kChains];
};

// What a backward pass finds out. Where no shape and no weight needs a gradient, nothing needs what lies
// behind.
enum class Need { kShape, kWeight, kValuesOnly };

// A Gaussian over one block. With registers to spare it is looked at while the block before is worked on:
// when its turn comes it is known which chains it adds to, and a branch guessed wrong costs little.
constexpr bool kLooksAhead = kNativeBytes == 64;
template <class T, int kChains>
struct Look {
  const T *upstream;
  T *state;
  Footprint<T> print;
  Mask<T> reached[kChains];
};
template <class T, int kChains>
VLGS_INLINE Look<T, kChains> look_at(const Tile<T> &tile, const T *g, uint32_t blocks) {
  const int64_t b = __builtin_ctz(blocks);
  Look<T, kChains> look;
  look.upstream = tile.upstream + b * tile.upstream_stride;
  look.state = tile.state + b * state_size(kChains);
  look.print = footprint(g, load(look.state + kCentreX * kLanes), load(look.state + kCentreY * kLanes));
  for (int c = 0; c < kChains; ++c) {
    const T *last = look.state + (kChainState + c * kChainStates + kLast) * kLanes;
    look.reached[c] =
        (look.print.o.exponent <= splat(g[kChains0 + 2 * c + kCutoff])) & (splat(g[kPlace]) <= load(last));
  }
  return look;
}

// One chain of a Gaussian in a block: returns a T, and adds to h, the derivative by the negative exponent.
// toward is the derivative of the loss by a T. kClamp: whether a weight is so large that alpha_max may bind.
template <class T, int kChain, int kChains, Need kNeed, bool kClamp>
VLGS_INLINE Pack<T> step(const Tile<T> &tile, const T *g, const Look<T, kChains> &look, const Pack<T> &toward,
                         Sums<T, kChains> &sums, Pack<T> &h) {
  const Pack<T> zero = splat(T(0)), one = splat(T(1)), alpha_max = splat(tile.alpha_max);
  T *mine = look.state + (kChainState + kChain * kChainStates) * kLanes;
  const Pack<T> raw = splat(g[kChains0 + 2 * kChain + kWeight]) * look.print.falloff;
  const Pack<T> alpha = select(look.reached[kChain], kClamp ? min(raw, alpha_max) : raw, zero);
  const Pack<T> t = load(mine + kTransmittance * kLanes) * reciprocal(one - alpha);
  store(mine + kTransmittance * kLanes, t);
  const Pack<T> weight = alpha * t;
  if constexpr (kNeed == Need::kValuesOnly) return weight;

  const Pack<T> behind = load(mine + kBehind * kLanes), ahead = toward - behind;
  store(mine + kBehind * kLanes, fma(alpha, ahead, behind));
  Pack<T> moved = weight * ahead;
  if constexpr (kClamp) moved = select(raw <= alpha_max, moved, zero);  // the clamp passes no gradient
  sums.weight[kChain] = sums.weight[kChain] + moved;
  if (kNeed == Need::kShape && tile.pass->shape_grad[kChain]) h = h + moved;
  return weight;
}

template <class T, int kChains>
VLGS_INLINE void add_moments(const Offset<T> &o, const Pack<T> &h, Sums<T, kChains> &sums) {
  const Pack<T> hu = h * o.u, hv = h * o.v;
  sums.moment[kMomentU] = sums.moment[kMomentU] + hu;
  sums.moment[kMomentV] = sums.moment[kMomentV] + hv;
  sums.moment[kMomentUU] = fma(hu, o.u, sums.moment[kMomentUU]);
  sums.moment[kMomentUV] = fma(hu, o.v, sums.moment[kMomentUV]);
  sums.moment[kMomentVV] = fma(hv, o.v, sums.moment[kMomentVV]);
}

// A chain of which the Gaussian reaches no pixel in the block is passed over: alpha would be 0, which leaves
// every bit of the state and of the sums. In trained scenes colour and language share a third of their
// blocks.
template <class T, int kChain, int kChains, int kParts, Need kNeed, bool kClamp>
VLGS_INLINE void chain_narrow(const Tile<T> &tile, const T *g, const Look<T, kChains> &look,
                              Sums<T, kChains> &sums, Pack<T> &h, Pack<T> *d_values) {
  constexpr int kBegin = 3 * kChain, kEnd = kChains == 1 ? 3 * kParts : 3 * kChain + 3;
  if (!tile.pass->used[kChain] || !any(look.reached[kChain])) return;
  Pack<T> toward = splat(T(0));
  if constexpr (kNeed != Need::kValuesOnly) {
    toward = load(look.upstream + (4 * kParts + kChain) * kLanes);
    for (int k = kBegin; k < kEnd; ++k)
      toward = fma(splat(g[kValues + k]), load(look.upstream + (k / 3 * 4 + k % 3) * kLanes), toward);
  }
  const Pack<T> weight = step<T, kChain, kChains, kNeed, kClamp>(tile, g, look, toward, sums, h);
  if (tile.pass->value_grads)
    for (int k = kBegin; k < kEnd; ++k)
      d_values[k] = fma(weight, load(look.upstream + (k / 3 * 4 + k % 3) * kLanes), d_values[k]);
}

// Parts of three channels, one per chain or all on one chain: their gradients are summed in registers too.
template <class T, int kChains, int kParts, Need kNeed, bool kClamp>
VLGS_INLINE void gaussian_narrow(const Tile<T> &tile, const T *g, uint32_t blocks, T *slot) {
  Pack<T> all[kLanes];
  for (auto &a : all) a = splat(T(0));
  Sums<T, kChains> sums{};
  Pack<T> d_values[3 * kParts];
  for (auto &d : d_values) d = splat(T(0));
  Look<T, kChains> next;
  if (kLooksAhead) next = look_at<T, kChains>(tile, g, blocks);
  while (blocks) {
    const Look<T, kChains> look = kLooksAhead ? next : look_at<T, kChains>(tile, g, blocks);
    blocks &= blocks - 1;
    if (kLooksAhead && blocks) next = look_at<T, kChains>(tile, g, blocks);
    Pack<T> h = splat(T(0));
    chain_narrow<T, 0, kChains, kParts, kNeed, kClamp>(tile, g, look, sums, h, d_values);
    if constexpr (kChains == 2)
      chain_narrow<T, 1, kChains, kParts, kNeed, kClamp>(tile, g, look, sums, h, d_values);
    if constexpr (kNeed == Need::kShape) add_moments(look.print.o, h, sums);
  }
  for (int i = 0; i < 5; ++i) all[i] = sums.moment[i];
  for (int c = 0; c < kChains; ++c) all[kSlotWeight0 + c] = sums.weight[c];
  for (int k = 0; k < 3 * kParts; ++k) all[kSlotValues + k] = d_values[k];
  sum_lanes(all, slot);
}

template <class T>
VLGS_INLINE Pack<T> project_values(const T *values, const T *upstream, int64_t channels, Pack<T> start) {
  Pack<T> acc[4] = {start, splat(T(0)), splat(T(0)), splat(T(0))};
  int64_t k = 0;
  for (; k + 4 <= channels; k += 4)
    for (int i = 0; i < 4; ++i) acc[i] = fma(splat(values[k + i]), load(upstream + (k + i) * kLanes), acc[i]);
  for (; k < channels; ++k) acc[0] = fma(splat(values[k]), load(upstream + k * kLanes), acc[0]);
  return (acc[0] + acc[2]) + (acc[1] + acc[3]);
}

// Gradients of kWidth channels (a multiple of 4, at most 16), summed over the blocks.
template <class T, int kChains, int kWidth>
VLGS_INLINE void value_gradients(const Tile<T> &tile, int chain, uint32_t blocks, int64_t offset, T *slot) {
  Pack<T> acc[kLanes];
  for (auto &a : acc) a = splat(T(0));
  const T *weights = tile.state + (kChainState + chain * kChainStates + kAlphaT) * kLanes;
  for (; blocks; blocks &= blocks - 1) {
    const int64_t b = __builtin_ctz(blocks);
    const Pack<T> weight = load(weights + b * state_size(kChains));
    const T *upstream = tile.upstream + b * tile.upstream_stride + offset * kLanes;
    for (int k = 0; k < kWidth; ++k) acc[k] = fma(weight, load(upstream + k * kLanes), acc[k]);
  }
  T sums[kLanes];
  sum_lanes(acc, sums);
  for (int k = 0; k < kWidth; ++k) slot[k] = sums[k];
}

// The first channels are summed together with the moments, which leave that much room.
template <Need kNeed>
constexpr int kLead = kNeed == Need::kValuesOnly ? 0 : 4;

// As chain_narrow; whether a pixel is reached.
template <class T, int kChain, int kChains, Need kNeed, bool kClamp>
VLGS_INLINE bool chain_wide(const Tile<T> &tile, const T *g, const Look<T, kChains> &look,
                            Sums<T, kChains> &sums, Pack<T> &h, Pack<T> *lead) {
  const Pass<T> &p = *tile.pass;
  if (!p.used[kChain] || !any(look.reached[kChain])) return false;
  Pack<T> toward = splat(T(0));
  if constexpr (kNeed != Need::kValuesOnly) {
    toward = load(look.upstream + (p.padded_channels + kChain) * kLanes);
    const T *upstream = look.upstream;
    for (int i = 0; i < p.num_parts; ++i) {
      const Part<T> &part = p.parts[i];
      if (part.chain == kChain && part.d_image)
        toward = project_values(part.values + row_of(g) * part.channels, upstream, part.channels, toward);
      upstream += part.padded * kLanes;
    }
  }
  const Pack<T> weight = step<T, kChain, kChains, kNeed, kClamp>(tile, g, look, toward, sums, h);
  store(look.state + (kChainState + kChain * kChainStates + kAlphaT) * kLanes, weight);
  if (p.parts[0].chain == kChain)
    for (int k = 0; k < kLead<kNeed>; ++k) lead[k] = fma(weight, load(look.upstream + k * kLanes), lead[k]);
  return true;
}

template <class T, int kChains, Need kNeed, bool kClamp>
inline void gaussian_wide(const Tile<T> &tile, const T *g, uint32_t blocks, T *slot) {
  const Pass<T> &p = *tile.pass;
  const Part<T> &front = p.parts[0];
  Sums<T, kChains> sums{};
  Pack<T> lead[kLead<kNeed> + 1];
  for (auto &l : lead) l = splat(T(0));
  uint32_t reached[kChains] = {};  // blocks
  Look<T, kChains> next;
  if (kLooksAhead) next = look_at<T, kChains>(tile, g, blocks);
  while (blocks) {
    const Look<T, kChains> look = kLooksAhead ? next : look_at<T, kChains>(tile, g, blocks);
    const uint32_t block = blocks & -blocks;
    blocks &= blocks - 1;
    if (kLooksAhead && blocks) next = look_at<T, kChains>(tile, g, blocks);
    Pack<T> h = splat(T(0));
    if (chain_wide<T, 0, kChains, kNeed, kClamp>(tile, g, look, sums, h, lead)) reached[0] |= block;
    if constexpr (kChains == 2)
      if (chain_wide<T, 1, kChains, kNeed, kClamp>(tile, g, look, sums, h, lead)) reached[1] |= block;
    if constexpr (kNeed == Need::kShape) add_moments(look.print.o, h, sums);
  }
  if constexpr (kNeed != Need::kValuesOnly) {
    Pack<T> all[kLanes];
    for (auto &a : all) a = splat(T(0));
    for (int i = 0; i < 5; ++i) all[i] = sums.moment[i];
    for (int c = 0; c < kChains; ++c) all[kSlotWeight0 + c] = sums.weight[c];
    for (int k = 0; k < kLead<kNeed>; ++k) all[kSlotHead + k] = lead[k];
    T head[kLanes];
    sum_lanes(all, head);
    for (int i = 0; i < kSlotHead; ++i) slot[i] = head[i];
    if (front.value_grad)
      for (int k = 0; k < kLead<kNeed>; ++k) slot[front.slot + k] = head[kSlotHead + k];
  } else {
    for (int i = 0; i < kSlotHead; ++i) slot[i] = 0;
  }

  int64_t offset = 0;
  for (int i = 0; i < p.num_parts; ++i) {
    const Part<T> &part = p.parts[i];
    T *to = slot + part.slot;
    int64_t k = i == 0 ? kLead<kNeed> : 0;
    if (part.value_grad) {
      const uint32_t in = reached[part.chain];
      for (; k + 16 <= part.padded; k += 16)
        value_gradients<T, kChains, 16>(tile, part.chain, in, offset + k, to + k);
      const int64_t left = part.padded - k;
      if (left == 12) value_gradients<T, kChains, 12>(tile, part.chain, in, offset + k, to + k);
      if (left == 8) value_gradients<T, kChains, 8>(tile, part.chain, in, offset + k, to + k);
      if (left == 4) value_gradients<T, kChains, 4>(tile, part.chain, in, offset + k, to + k);
    }
    offset += part.padded;
  }
}

template <class T, int kChains, Need kNeed, bool kClamp>
VLGS_INLINE void gaussian(const Tile<T> &tile, const T *g, uint32_t blocks, T *slot) {
  if (!tile.pass->narrow)
    gaussian_wide<T, kChains, kNeed, kClamp>(tile, g, blocks, slot);
  else if (kChains == 1 && tile.pass->num_parts == 1)
    gaussian_narrow<T, 1, 1, kNeed, kClamp>(tile, g, blocks, slot);
  else
    gaussian_narrow<T, kChains, kNarrowParts, kNeed, kClamp>(tile, g, blocks, slot);
}

template <class T, int kChains, Need kNeed>
void rasterize_tile_backward(const Tile<T> &given, T *slots) {
  // A clamp that does not bind moves no bit: where all shapes are frozen it is not worth a code without it.
  constexpr bool kAlwaysClamps = kNeed != Need::kShape;
  const Tile<T> tile = given;  // a copy that no store can reach stays in registers
  const Pass<T> &p = *tile.pass;
  Live live = live_blocks(tile);
  for (int64_t place = tile.count - 1; place >= 0; --place) {
    const uint32_t blocks = p.masks[tile.begin + place] & live.at(place);
    T *slot = slots + place * p.slot_size;
    const T *g = tile.records + place * kRecord;
    bool clamps = kAlwaysClamps;
    for (int c = 0; c < kChains; ++c) clamps |= g[kChains0 + 2 * c + kWeight] > tile.alpha_max;
    if (!blocks)
      for (int64_t i = 0; i < p.slot_size; ++i) slot[i] = 0;
    else if (clamps)
      gaussian<T, kChains, kNeed, true>(tile, g, blocks, slot);
    else
      gaussian<T, kChains, kNeed, kAlwaysClamps>(tile, g, blocks, slot);
  }
}

template <class T, int kChains>
void rasterize_tile_backward(const Tile<T> &tile, T *slots) {
  const Pass<T> &p = *tile.pass;
  if (p.shape_grads)
    rasterize_tile_backward<T, kChains, Need::kShape>(tile, slots);
  else if (p.weight_grads)
    rasterize_tile_backward<T, kChains, Need::kWeight>(tile, slots);
  else
    rasterize_tile_backward<T, kChains, Need::kValuesOnly>(tile, slots);
}

}  // namespace

int64_t rasterize_backward_scratch(const Pass<T> &p, int64_t list_length) {
  return list_length * kRecord + kBlocks * ((p.padded_channels + p.chains) * kLanes + state_size(p.chains));
}

bool rasterize_backward(const Pass<T> &p, int64_t index, T *scratch, T *slots) {
  const int64_t begin = p.tile_begin[index], count = p.tile_begin[index + 1] - begin;
  Carver<T> carver{scratch};
  Tile<T> tile{};
  tile.pass = &p, tile.alpha_max = p.alpha_max;
  tile.index = index, tile.begin = begin, tile.count = count;
  T *records = carver.take(count * kRecord);
  tile.records = records;
  tile.upstream_stride = (p.padded_channels + p.chains) * kLanes;
  tile.upstream = carver.take(kBlocks * tile.upstream_stride);
  tile.state = carver.take(kBlocks * state_size(p.chains));
  if (!load_upstream(tile)) return false;
  gather_records(p, begin, begin + count, records);
  for (int b = 0; b < kBlocks; ++b) {
    T *state = tile.state + b * state_size(p.chains);
    const Centres<T> at = centres<T>(p.grid, index, b);
    store(state + kCentreX * kLanes, at.x);
    store(state + kCentreY * kLanes, at.y);
    for (int c = 0; c < p.chains; ++c) {
      const int64_t from = ((index * p.chains + c) * kBlocks + b) * kLanes;
      T *chain = state + (kChainState + c * kChainStates) * kLanes;
      store(chain + kLast * kLanes, load(p.last + from));
      store(chain + kTransmittance * kLanes, load(p.transmittance + from));
      store(chain + kBehind * kLanes, splat(T(0)));
    }
  }
  p.chains == 1 ? rasterize_tile_backward<T, 1>(tile, slots) : rasterize_tile_backward<T, 2>(tile, slots);
  return true;
}

}  // namespace vlgs::VLGS_ISA_NS
