// The page: what is drawn when, and what its buttons do.

const find = (id) => document.getElementById(id);
const AIM = 30; // milliseconds between frames of a moving picture, which is drawn with fewer pixels if it takes longer

class Page {
  constructor(painter) {
    this.painter = painter;
    this.canvas = painter.canvas;
    this.sorter = new Sorter(painter.places);
    this.word = null;
    this.touched = -Infinity; // when the view was last moved
    this.pace = 0; // milliseconds between frames while it moves
    this.share = 1; // of the pixels along an axis, while it moves
    this.step = 0; // its logarithm
    this.seat(0);
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
    if (this.painter.busy()) return this.show();
    const moving = now - this.touched < 250;
    this.measure(now, moving);
    this.draw(moving ? this.share : 1);
    this.sort();
    if (moving) this.show(); // and once more when it rests, with all pixels
  }

  // Frames a second, in small letters, while there is motion; and with how many pixels a moving picture is drawn.
  measure(now, moving) {
    if (moving && this.last) {
      this.pace += (now - this.last - this.pace) / (this.pace ? 4 : 1);
      find("rate").textContent = `${Math.round(1000 / this.pace)} frames/s`;
      // The work goes with the square of the share. Steps of the root of 2, so that a size lasts for some frames.
      const wanted = this.share * Math.sqrt(AIM / this.pace);
      const step = Math.round(2 * Math.log2(Math.min(1, Math.max(0.2, wanted))));
      if (Math.abs(step - this.step) > 1 || step === 0) this.step = step;
      this.share = 2 ** (this.step / 2);
    }
    if (!moving) find("rate").textContent = "";
    this.last = moving ? now : 0;
  }

  draw(share) {
    const ratio = Math.min(devicePixelRatio || 1, 2) * share;
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map((side) => Math.max(1, Math.round(side * ratio)));
    this.painter.paint(this.view, width, height, ...this.style());
  }

  // What `Painter.paint` is told: how to show the word, and where its threshold and its heat begin and end among its bytes.
  style() {
    if (this.word === null) return ["colour"];
    const { stored, heat } = about.words[this.word];
    const share = (relevancy) => (relevancy - stored[0]) / (stored[1] - stored[0] || 1);
    const shown = document.querySelector("input[name=shown]:checked").value;
    return [shown, share(find("threshold").valueAsNumber), heat.map(share)];
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

  // Ask a word of `about.words` by its place; null, or the one that is asked already: none.
  ask(index) {
    this.word = index === this.word ? null : index;
    for (const [i, button] of [...find("words").children].entries()) button.setAttribute("aria-pressed", String(i === this.word));
    find("answer").hidden = this.word === null;
    if (this.word !== null) {
      const { stored, threshold } = about.words[this.word];
      Object.assign(find("threshold"), { min: stored[0], max: stored[1], step: "any", value: threshold });
      this.painter.ask(this.word);
    }
    this.tell();
  }

  tell() {
    find("value").value = find("threshold").valueAsNumber.toFixed(3);
    const asked = this.word === null ? "" : `, asked for ${about.words[this.word].name}`;
    find("status").textContent = `${about.count.toLocaleString()} Gaussians${asked}.`;
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
  followHand(page.canvas, { orbit: (x, y) => turn(-x * angle(), -y * angle()), pan, dolly });

  const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  const keys = {
    "+": () => dolly(0.9), "=": () => dolly(0.9), "-": () => dolly(1 / 0.9),
    "[": () => page.seat(page.camera - 1), "]": () => page.seat(page.camera + 1), r: () => page.seat(0),
    Escape: () => page.word !== null && page.ask(page.word),
  };
  addEventListener("keydown", (event) => {
    const way = ways[event.key];
    const theirs = event.target.matches("select") ? event.key !== "Escape" : event.target.matches("input") && way;
    if (theirs || event.ctrlKey || event.metaKey || event.altKey) return;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (way && event.shiftKey) pan(-20 * way[0], -20 * way[1]);
    else if (way) turn(0.05 * way[0], 0.05 * way[1]);
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
    // Chooses a word by its text; null: none.
    ask: (word) => {
      const index = word === null ? page.word : about.words.findIndex(({ name }) => name === word);
      if (index === -1) throw new Error(`no word ${word}`);
      if (word === null || index !== page.word) page.ask(index);
    },
  };
}

// A promise of the above; undefined where there is only a picture.
window.vlgs = start().catch((error) => giveUp(error.message));
