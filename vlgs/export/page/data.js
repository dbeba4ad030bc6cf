// Unpacks what vlgs/export/packed.py wrote: columns of small whole numbers, gzipped, in base64.

const ROW = 512; // splats in a row of a texture
const TEXELS = 3; // of four 32-bit numbers, for a splat: place and colour, covariance

const about = JSON.parse(document.getElementById("about").textContent);

async function bytesOf(id) {
  const letters = atob(document.getElementById(id).textContent.trim());
  const packed = new Uint8Array(letters.length);
  for (let i = 0; i < packed.length; i++) packed[i] = letters.charCodeAt(i);
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Name -> planes of one byte for each splat.
function columnsOf(bytes) {
  const columns = {};
  let at = 0;
  for (const [name, count] of about.columns) {
    columns[name] = Array.from({ length: count }, () => bytes.subarray(at, (at += about.count)));
  }
  return columns;
}

// Centres, three numbers for each splat. What lies far away is stored more coarsely: see packed.py.
function placesOf(columns) {
  const { center, unit, low, high } = about.places;
  const places = new Float32Array(3 * about.count);
  for (let axis = 0; axis < 3; axis++) {
    const [coarse, fine] = columns.places.slice(2 * axis);
    const step = (high[axis] - low[axis]) / 65535;
    for (let i = 0; i < about.count; i++) {
      const folded = low[axis] + step * (256 * coarse[i] + fine[i]);
      places[3 * i + axis] = center[axis] + unit * Math.sign(folded) * Math.expm1(Math.abs(folded));
    }
  }
  return places;
}

// What the GPU reads of each splat; `quats` and `scales` are columns, of colour's shape or of language's own.
function textureOf(columns, places, quats, scales) {
  const words = new Uint32Array(Math.ceil(about.count / ROW) * ROW * TEXELS * 4);
  const floats = new Float32Array(words.buffer);
  const { low, high } = about.scales;
  const variances = Float64Array.from({ length: 256 }, (_, i) => Math.exp(2 * (low + ((high - low) * i) / 255)));
  const [red, green, blue] = columns.color;
  const [opacity] = columns.opacity;
  for (let i = 0; i < about.count; i++) {
    const at = i * TEXELS * 4;
    floats.set(places.subarray(3 * i, 3 * i + 3), at);
    words[at + 3] = red[i] | (green[i] << 8) | (blue[i] << 16) | (opacity[i] << 24);
    floats.set(covarianceOf(quats.map((plane) => plane[i] - 127), scales.map((plane) => variances[plane[i]])), at + 4);
  }
  return words;
}

// Six numbers of R diag(variances) R^T: xx, xy, xz, yy, yz, zz. The quaternion (w, x, y, z) may have any length.
function covarianceOf(quat, variances) {
  const length = Math.hypot(...quat) || 1;
  const [w, x, y, z] = quat.map((value) => value / length);
  const axes = [
    [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
    [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
    [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
  ];
  const sum = (i, j) => axes.reduce((total, axis, k) => total + variances[k] * axis[i] * axis[j], 0);
  return [sum(0, 0), sum(0, 1), sum(0, 2), sum(1, 1), sum(1, 2), sum(2, 2)];
}
