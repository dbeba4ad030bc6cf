// The page: what is drawn when, and what its buttons do.

const find = (id) => document.getElementById(id);
const SLOW = 45; // milliseconds for a frame, above which a moving picture is drawn with half the pixels

class Page {
  constructor(painter) {
    this.painter = painter;
    this.canvas = painter.canvas;
    this.sorter = new Sorter(painter.places);
    this.word = null;
    this.pace = 0; // mean of milliseconds between frames while the picture moves
    this.touched = 0;
    this.seat(about.start);
    new ResizeObserver(() => this.show()).observe(this.canvas);
  }

  // Look from a photograph's camera.
  seat(index) {
    this.camera = (index + about.cameras.length) % about.cameras.length;
    this.view = new View(about.cameras[this.camera], about.focus);
    find("cameras").value = this.camera;
    this.show();
  }

  // Draw as soon as the browser wants a frame.
  show(moved = false) {
    if (moved) this.touched = performance.now();
    this.wanted ||= requestAnimationFrame((now) => this.frame(now));
  }

  move(change) {
    change(this.view);
    this.show(true);
  }

  frame(now) {
    this.wanted = 0;
    if (this.lent) return; // to `look`
    const moving = now - this.touched < 250;
    this.measure(now, moving);
    this.draw(moving && this.pace > SLOW ? 0.5 : 1);
    this.sort();
    if (moving) this.show(); // and once more when it rests, with all pixels
  }

  // Frames a second, in small letters, while there is motion.
  measure(now, moving) {
    if (moving && this.last && now - this.last < 1000) this.pace += (now - this.last - this.pace) / 8;
    this.last = moving ? now : 0;
    find("rate").textContent = moving && this.pace ? `${Math.round(1000 / this.pace)} frames/s` : "";
  }

  draw(share) {
    const ratio = Math.min(devicePixelRatio || 1, 2) * share;
    this.painter.paint(
      this.view, Math.max(1, Math.round(this.canvas.clientWidth * ratio)), Math.max(1, Math.round(this.canvas.clientHeight * ratio)),
      ...this.style(),
    );
  }

  style() {
    if (this.word === null) return ["colour", 0];
    const { low, high } = about.words[this.word];
    const shown = document.querySelector("input[name=shown]:checked").value;
    return [shown, (find("threshold").valueAsNumber - low) / (high - low || 1)];
  }

  // Put splats in order if the direction of the view has changed; one worker, one question at a time.
  async sort() {
    const { ahead } = this.view;
    if (this.sorting || (this.sorted && dot(ahead, this.sorted) > 1 - 1e-9)) return;
    this.sorting = true;
    const order = await this.sorter.sort(ahead);
    this.sorting = false;
    if (this.lent) return;
    this.painter.order(order);
    this.sorted = ahead;
    this.show();
  }

  // Ask a word of `about.words` by its place; null: none.
  ask(index) {
    this.word = index === this.word ? null : index;
    for (const [i, button] of [...find("words").children].entries()) button.setAttribute("aria-pressed", String(i === this.word));
    find("answer").hidden = this.word === null;
    if (this.word !== null) {
      const { low, high, threshold } = about.words[this.word];
      Object.assign(find("threshold"), { min: low, max: high, step: (high - low) / 200 || "any", value: threshold });
      this.painter.ask(this.word);
    }
    this.tell();
  }

  tell() {
    const value = find("threshold").valueAsNumber.toFixed(3);
    find("value").value = value;
    const said = this.word === null ? "" : `${about.words[this.word].name}: above a relevancy of ${value}`;
    find("status").textContent = said || `${about.count.toLocaleString()} Gaussians.`;
    this.show();
  }

  // See `vlgs.look` below.
  async look({ viewmat, K, width, height }) {
    const flat = viewmat.flat();
    const lens = [K[0][0], K[1][1], K[0][2], K[1][2]];
    const view = new View({ viewmat: flat, lens, size: [width, height] }, about.focus);
    this.lent = true;
    this.painter.order(await this.sorter.sort(view.ahead));
    this.painter.paint(view, width, height, ...this.style());
    const picture = this.canvas.toDataURL("image/png");
    this.lent = false;
    this.sorted = null;
    this.show();
    return picture;
  }
}

function connect(page) {
  for (const [index, { name }] of about.words.entries()) {
    const button = document.createElement("button");
    Object.assign(button, { type: "button", textContent: name, onclick: () => page.ask(index) });
    button.setAttribute("aria-pressed", "false");
    find("words").append(button);
  }
  find("asking").hidden = about.words.length === 0;
  for (const [index, { name, split }] of about.cameras.entries()) find("cameras").append(new Option(`${name} (${split})`, index));
  find("cameras").value = page.camera;
  find("cameras").onchange = (event) => page.seat(Number(event.target.value));
  find("before").onclick = () => page.seat(page.camera - 1);
  find("after").onclick = () => page.seat(page.camera + 1);
  find("threshold").oninput = () => page.tell();
  for (const choice of document.getElementsByName("shown")) choice.onchange = () => page.show();

  const size = () => [page.canvas.clientWidth, page.canvas.clientHeight];
  const turn = (across, over) => page.move((view) => view.orbit(across, over));
  const pan = (across, over) => page.move((view) => view.pan(across, over, ...size()));
  const dolly = (factor) => page.move((view) => view.dolly(factor));
  const angle = () => Math.PI / Math.min(...size()); // a turn by half the circle from one edge to the other
  followHand(page.canvas, { orbit: (x, y) => turn(x * angle(), -y * angle()), pan, dolly });

  const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  const keys = {
    "+": () => dolly(0.9), "=": () => dolly(0.9), "-": () => dolly(1 / 0.9),
    "[": () => page.seat(page.camera - 1), "]": () => page.seat(page.camera + 1), r: () => page.seat(about.start),
    Escape: () => page.word !== null && page.ask(page.word),
  };
  addEventListener("keydown", (event) => {
    const typing = /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName) && event.key !== "Escape";
    if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
    const way = ways[event.key];
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (way && event.shiftKey) pan(-20 * way[0], -20 * way[1]);
    else if (way) turn(-0.05 * way[0], 0.05 * way[1]);
    else if (keys[key]) keys[key]();
    else if (/^[1-9]$/.test(key) && about.words[key - 1]) page.ask(key - 1);
    else return;
    event.preventDefault();
  });
}

function giveUp(reason) {
  find("canvas").hidden = true;
  find("controls").hidden = true;
  find("rate").textContent = "";
  find("picture").hidden = false;
  find("status").textContent = `This is a picture of the scene: ${reason}.`;
}

async function start() {
  if (typeof DecompressionStream === "undefined") return giveUp("looking around needs a newer browser, with DecompressionStream");
  const canvas = find("canvas");
  if (!document.createElement("canvas").getContext("webgl2")) return giveUp("looking around needs WebGL 2, which this browser does not have or has turned off");
  const columns = columnsOf(await bytesOf("splats"));
  canvas.setAttribute("aria-label", `${document.title}, to look around in`);
  canvas.addEventListener("webglcontextlost", () => giveUp("the graphics driver has stopped; load the page again"));
  canvas.hidden = false;
  const page = new Page(new Painter(canvas, columns));
  connect(page);
  page.painter.order(await page.sorter.sort(page.view.ahead));
  find("controls").hidden = false;
  find("picture").hidden = true;
  page.tell();

  // For scripts and tests, in the browser's console too.
  return {
    about,
    // Draws from a camera of vlgs (viewmat 4x4, K 3x3, as lists of rows; width, height), and promises the picture as a data URL.
    look: (camera) => page.look(camera),
    // Chooses a word by its text, or none with null.
    ask: (word) => {
      const index = about.words.findIndex(({ name }) => name === word);
      if (word !== null && index < 0) throw new Error(`no word ${word}`);
      const wanted = word === null ? page.word : index;
      if (word === null ? page.word !== null : page.word !== index) page.ask(wanted);
    },
  };
}

// A promise of the above; undefined where there is only a picture.
window.vlgs = start().catch((error) => giveUp(error.message));
