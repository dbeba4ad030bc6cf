// Where the page looks from: camera axes as in vlgs (right, down, ahead), and what hand and keys do with them.

const plus = (a, b, k = 1) => a.map((value, i) => value + k * b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((value) => value / (Math.hypot(...a) || 1));

// A vector turned by an angle about an axis of length 1.
function turned(v, axis, angle) {
  const [cos, sin] = [Math.cos(angle), Math.sin(angle)];
  return plus(plus(v.map((value) => cos * value), cross(axis, v), sin), axis, (1 - cos) * dot(axis, v));
}

const STEEPEST = Math.cos(Math.PI / 30); // turning stops before it looks straight up or down

class View {
  // `viewmat`: the upper three rows of world to camera, row by row; `lens`: fx, fy, cx, cy in pixels of a picture of `size`.
  constructor({ viewmat, lens, size }, focus) {
    const rows = [0, 4, 8].map((at) => viewmat.slice(at, at + 3));
    const shift = [3, 7, 11].map((at) => viewmat[at]);
    [this.right, this.down, this.ahead] = rows;
    this.eye = [0, 1, 2].map((axis) => -rows.reduce((sum, row, i) => sum + row[axis] * shift[i], 0));
    this.lens = lens;
    this.size = size;
    this.distance = Math.max(dot(plus(focus, this.eye, -1), this.ahead), about.near * 10);
  }

  get target() {
    return plus(this.eye, this.ahead, this.distance);
  }

  // Focal lengths and centre for a picture of another size that shows at least what the photograph does.
  lensFor(width, height) {
    const [fx, fy, cx, cy] = this.lens;
    const zoom = Math.min(width / this.size[0], height / this.size[1]);
    return [zoom * fx, zoom * fy, width / 2 + zoom * (cx - this.size[0] / 2), height / 2 + zoom * (cy - this.size[1] / 2)];
  }

  // Around the target: `across` about the world's vertical, `over` about the camera's own horizontal; in radians.
  orbit(across, over) {
    const target = this.target;
    const turn = (axis, angle) => {
      for (const name of ["right", "down", "ahead"]) this[name] = turned(this[name], axis, angle);
    };
    turn(about.up, across);
    const steep = Math.abs(dot(turned(this.ahead, this.right, over), about.up));
    if (steep < STEEPEST || steep < Math.abs(dot(this.ahead, about.up))) turn(this.right, over);
    this.ahead = unit(this.ahead); // rounding adds up
    this.right = unit(plus(this.right, this.ahead, -dot(this.right, this.ahead)));
    this.down = cross(this.ahead, this.right);
    this.eye = plus(target, this.ahead, -this.distance);
  }

  // Sideways, by pixels of a picture of some size: what lies at the target's distance follows the hand.
  pan(across, over, width, height) {
    const [fx, fy] = this.lensFor(width, height);
    this.eye = plus(this.eye, this.right, (-across * this.distance) / fx);
    this.eye = plus(this.eye, this.down, (-over * this.distance) / fy);
  }

  // Towards the target (below 1) or away from it.
  dolly(factor) {
    const target = this.target;
    this.distance = Math.max(this.distance * factor, about.near * 2);
    this.eye = plus(target, this.ahead, -this.distance);
  }
}

// Calls back with what a hand on the canvas wants: turn or shift, in pixels, or come nearer by a factor.
function followHand(canvas, { orbit, pan, dolly }) {
  const held = new Map();
  const spread = () => {
    const [a, b] = [...held.values()];
    return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, wide: Math.hypot(a.x - b.x, a.y - b.y) || 1 };
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = held.get(event.pointerId);
    if (!last) return;
    const before = held.size > 1 ? spread() : last;
    held.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const now = held.size > 1 ? spread() : held.get(event.pointerId);
    const [across, over] = [now.x - before.x, now.y - before.y];
    if (held.size > 1) dolly(before.wide / now.wide);
    if (held.size > 1 || event.shiftKey || event.buttons > 1) pan(across, over);
    else orbit(across, over);
  });
  for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
    canvas.addEventListener(name, (event) => held.delete(event.pointerId));
  }
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 30 : 1; // Firefox counts lines
    dolly(Math.exp(Math.max(-200, Math.min(200, event.deltaY * lines)) / 600));
  }, { passive: false });
}
