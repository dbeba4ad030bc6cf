// Draws splats with WebGL 2: colour blended with opacity, and apart from it relevancy blended with the language weight.

class Painter {
  constructor(canvas, columns) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("WebGL 2 is missing here");
    this.canvas = canvas;
    this.gl = gl;
    this.columns = columns;
    // Eight bits a channel would lose what a hundred thin layers add up to.
    this.fine = Boolean(gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float"));
    this.splats = this.program(SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.whole = this.program(WHOLE_VERTEX, WHOLE_FRAGMENT);

    this.places = placesOf(columns);
    this.rows = Math.ceil(about.count / ROW);
    this.shapes = this.shapesOf(columns.quats, columns.scales);
    this.own = columns.language_quats ? this.shapesOf(columns.language_quats, columns.language_scales) : this.shapes;
    this.harmonics = this.harmonicsOf(columns.harmonics ?? []);
    this.answers = this.texture();
    const heat = Uint8Array.from(atob(about.heat), (letter) => letter.charCodeAt(0));
    this.heat = this.texture();
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, 256, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, heat);
    this.targets = [this.target(), this.target()];

    // Two triangles a splat in one mesh: an instance of four corners each is slow on most drivers.
    this.sequence = this.texture();
    const corners = new Uint32Array(6 * about.count);
    for (let i = 0; i < about.count; i++) corners.set([4 * i, 4 * i + 1, 4 * i + 2, 4 * i + 1, 4 * i + 3, 4 * i + 2], 6 * i);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
  }

  program(vertex, fragment) {
    const gl = this.gl;
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      const said = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
      throw new Error(`the graphics driver refuses a program: ${said.join(" ")}`);
    }
    const at = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const { name } = gl.getActiveUniform(program, i);
      at[name] = gl.getUniformLocation(program, name);
    }
    return { program, at };
  }

  texture(kind = this.gl.TEXTURE_2D) {
    const gl = this.gl;
    const texture = gl.createTexture();
    gl.bindTexture(kind, texture);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(kind, filter, gl.NEAREST);
    for (const wrap of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(kind, wrap, gl.CLAMP_TO_EDGE);
    return texture;
  }

  shapesOf(quats, scales) {
    const gl = this.gl;
    const texture = this.texture();
    const words = textureOf(this.columns, this.places, quats, scales);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, ROW * TEXELS, this.rows, 0, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words);
    return texture;
  }

  // A layer for each coefficient; `planes` has red, green and blue of the first, then of the second ...
  harmonicsOf(planes) {
    const gl = this.gl;
    const layers = Math.max(planes.length / 3, 1);
    const size = this.rows * ROW;
    const bytes = new Uint8Array(layers * size * 4);
    planes.forEach((plane, i) => {
      const start = Math.floor(i / 3) * size * 4 + (i % 3);
      for (let k = 0; k < about.count; k++) bytes[start + 4 * k] = plane[k];
    });
    const texture = this.texture(gl.TEXTURE_2D_ARRAY);
    gl.texImage3D(gl.TEXTURE_2D_ARRAY, 0, gl.RGBA8, ROW, this.rows, layers, 0, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    return texture;
  }

  target() {
    const gl = this.gl;
    const texture = this.texture();
    const frame = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    return { texture, frame, width: 0, height: 0 };
  }

  // The order in which splats are drawn from now on, the furthest first.
  order(indices) {
    const gl = this.gl;
    const rows = new Uint32Array(this.rows * ROW);
    rows.set(indices);
    gl.bindTexture(gl.TEXTURE_2D, this.sequence);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R32UI, ROW, this.rows, 0, gl.RED_INTEGER, gl.UNSIGNED_INT, rows);
  }

  // Which word is asked from now on, of `about.words`.
  ask(index) {
    const gl = this.gl;
    const relevancy = this.columns.relevancy[index];
    const weight = this.columns.weights[about.words[index].weight];
    const pairs = new Uint8Array(this.rows * ROW * 2);
    for (let i = 0; i < about.count; i++) {
      pairs[2 * i] = weight[i];
      pairs[2 * i + 1] = relevancy[i];
    }
    gl.bindTexture(gl.TEXTURE_2D, this.answers);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RG8, ROW, this.rows, 0, gl.RG, gl.UNSIGNED_BYTE, pairs);
    this.asked = true;
  }

  // Draws into the canvas at a size in pixels. `shown`: "colour", "heat" or "cut"; `threshold` and both ends of the heat are shares of a
  // word's bytes.
  paint(view, width, height, shown, threshold = 0, [cold, hot] = [0, 1]) {
    const gl = this.gl;
    if (this.canvas.width !== width) this.canvas.width = width;
    if (this.canvas.height !== height) this.canvas.height = height;
    this.layer(this.targets[0], view, width, height, false);
    if (shown !== "colour") this.layer(this.targets[1], view, width, height, true);

    const { program, at } = this.whole;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.BLEND);
    gl.useProgram(program);
    this.bind(at.color, 0, this.targets[0].texture);
    this.bind(at.language, 1, this.targets[1].texture);
    this.bind(at.heat, 2, this.heat);
    gl.uniform1i(at.shown, { colour: 0, heat: 1, cut: 2 }[shown]);
    gl.uniform1f(at.threshold, threshold);
    gl.uniform2f(at.ends, cold, hot);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.deleteSync(this.fence ?? null);
    this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
  }

  // Whether the last picture is not finished yet; more than one at a time would only make the page slow to answer.
  busy() {
    return Boolean(this.fence) && this.gl.getSyncParameter(this.fence, this.gl.SYNC_STATUS) === this.gl.UNSIGNALED;
  }

  layer(target, view, width, height, language) {
    const gl = this.gl;
    const { program, at } = this.splats;
    if (target.width !== width || target.height !== height) {
      gl.bindTexture(gl.TEXTURE_2D, target.texture);
      const [form, kind] = this.fine ? [gl.RGBA16F, gl.HALF_FLOAT] : [gl.RGBA8, gl.UNSIGNED_BYTE];
      gl.texImage2D(gl.TEXTURE_2D, 0, form, width, height, 0, gl.RGBA, kind, null);
      Object.assign(target, { width, height });
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(program);
    const [fx, fy, cx, cy] = view.lensFor(width, height);
    const [beyondX, beyondY] = [(about.margin * width) / 2, (about.margin * height) / 2];
    gl.uniform3fv(at.right, view.right);
    gl.uniform3fv(at.down, view.down);
    gl.uniform3fv(at.ahead, view.ahead);
    gl.uniform3fv(at.eye, view.eye);
    gl.uniform4f(at.lens, fx, fy, cx, cy);
    gl.uniform2f(at.size, width, height);
    gl.uniform4f(at.slopes, -(cx + beyondX) / fx, -(cy + beyondY) / fy, (width - cx + beyondX) / fx, (height - cy + beyondY) / fy);
    gl.uniform1f(at.near, about.near);
    gl.uniform1f(at.nearSigmas, about.near_sigmas);
    gl.uniform1f(at.blur, about.blur);
    gl.uniform1f(at.least, about.alpha[0]);
    gl.uniform1f(at.most, about.alpha[1]);
    gl.uniform2f(at.colors, ...about.color);
    gl.uniform2f(at.further, ...about.harmonics);
    gl.uniform1i(at.coefficients, (this.columns.harmonics ?? []).length / 3);
    gl.uniform1i(at.language, Number(language));
    this.bind(at.shapes, 0, language ? this.own : this.shapes);
    this.bind(at.answers, 1, this.answers);
    this.bind(at.harmonics, 2, this.harmonics, gl.TEXTURE_2D_ARRAY);
    this.bind(at.sequence, 3, this.sequence);
    gl.drawElements(gl.TRIANGLES, 6 * about.count, gl.UNSIGNED_INT, 0);
  }

  bind(location, unit, texture, kind = this.gl.TEXTURE_2D) {
    this.gl.activeTexture(this.gl.TEXTURE0 + unit);
    this.gl.bindTexture(kind, texture);
    this.gl.uniform1i(location, unit);
  }
}
