// Puts splats in order of depth, in a worker, so that the page answers while it counts.

// Indices, the furthest splat first: a counting sort over 65536 slices of depth along a direction.
function furthestFirst(places, [x, y, z]) {
  const count = places.length / 3;
  const depths = new Float32Array(count);
  let low = Infinity;
  let high = -Infinity;
  for (let i = 0; i < count; i++) {
    const depth = x * places[3 * i] + y * places[3 * i + 1] + z * places[3 * i + 2];
    depths[i] = depth;
    if (depth < low) low = depth;
    if (depth > high) high = depth;
  }
  const scale = high > low ? 65535 / (high - low) : 0;
  const starts = new Uint32Array(65537);
  const slices = new Uint16Array(count);
  for (let i = 0; i < count; i++) {
    slices[i] = 65535 - Math.round((depths[i] - low) * scale);
    starts[slices[i] + 1]++;
  }
  for (let slice = 0; slice < 65536; slice++) starts[slice + 1] += starts[slice];
  const order = new Uint32Array(count);
  for (let i = count - 1; i >= 0; i--) {
    // Of two at one depth the later one is further away, as in vlgs.
    const slice = slices[i];
    order[starts[slice]++] = i;
  }
  return order;
}

class Sorter {
  constructor(places) {
    this.places = places;
    this.waiting = [];
    try {
      const source = `${furthestFirst}
        let places;
        onmessage = ({ data }) => {
          if (data.places) return void (places = data.places);
          const order = furthestFirst(places, data.ahead);
          postMessage(order, [order.buffer]);
        };`;
      const address = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
      this.worker = new Worker(address);
      this.worker.onmessage = ({ data }) => this.waiting.shift()(data);
      this.worker.postMessage({ places });
    } catch {
      this.worker = null; // a browser that lets no file start workers: the page does it itself
    }
  }

  // A promise of `furthestFirst`.
  sort(ahead) {
    if (!this.worker) return Promise.resolve(furthestFirst(this.places, ahead));
    return new Promise((resolve) => {
      this.waiting.push(resolve);
      this.worker.postMessage({ ahead });
    });
  }
}
