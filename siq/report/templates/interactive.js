/* U that can be turned and cut. Data stand in the page; nothing is loaded, and nothing in them is run. */
(function () {
  "use strict";
  const root = document.currentScript.closest(".view-of-u");
  const data = JSON.parse(root.querySelector("script[type='application/json']").textContent);
  const d = data.names.length, size = data.shape;
  const packed = atob(data.grid), grid = new Uint8Array(packed.length);
  for (let i = 0; i < packed.length; i++) grid[i] = packed.charCodeAt(i);
  const ABOVE = 254, UNKNOWN = 255;
  const stride = size.map((_, k) => size.slice(k + 1).reduce((a, b) => a * b, 1));
  const scale = (k, value) => (value - data.box[k][0]) / (data.box[k][1] - data.box[k][0]);
  const energy = q => data.low + (q / 253) * (data.high - data.low);
  const COLOURS = [[27, 79, 138], [79, 143, 196], [163, 203, 229], [207, 226, 238], [223, 236, 244]];
  function number(x) {
    if (Math.abs(x) < 1e-12 * (Math.abs(data.high) + Math.max(...data.box.flat().map(Math.abs)))) return "0";
    const plain = Math.abs(x) < 1e4 && Math.abs(x) >= 1e-2;
    return String(plain ? Number(x.toPrecision(3)) : x.toExponential(1)).replace("e-", "e−").replace(/^-/, "−");
  }
  const find = name => root.querySelector("[data-part='" + name + "']");

  // Round numbers within limits, two to five of them.
  function ticks([low, high]) {
    const rough = (high - low) / 4, ten = Math.pow(10, Math.floor(Math.log10(rough)));
    const step = [1, 2, 5, 10].map(x => x * ten).find(x => x >= rough), found = [];
    for (let k = Math.ceil(low / step); k * step <= high; k++) found.push(k * step);
    return found;
  }

  function colour(share) {
    const x = Math.min(Math.max(share, 0), 1) * (COLOURS.length - 1), i = Math.min(Math.floor(x), COLOURS.length - 2);
    return COLOURS[i].map((c, k) => Math.round(c + (x - i) * (COLOURS[i + 1][k] - c)));
  }

  // U between the points of the grid, in steps of its numbers; NaN nearer to where it is not known.
  function value(place) {
    let sum = 0, known = 0;
    const low = [], part = [];
    for (let k = 0; k < d; k++) {
      const x = Math.min(Math.max(scale(k, place[k]), 0), 1) * (size[k] - 1);
      low[k] = Math.min(Math.floor(x), size[k] - 2);
      part[k] = x - low[k];
    }
    for (let corner = 0; corner < 1 << d; corner++) {
      let weight = 1, at = 0;
      for (let k = 0; k < d; k++) {
        const up = (corner >> k) & 1;
        weight *= up ? part[k] : 1 - part[k];
        at += (low[k] + up) * stride[k];
      }
      if (weight === 0 || grid[at] === UNKNOWN) continue;
      known += weight;
      sum += weight * grid[at];
    }
    return known < 0.5 ? NaN : sum / known;
  }

  // A canvas as sharp as the screen; drawing is asked for and happens once a frame.
  function painter(canvas, draw) {
    let asked = false;
    function paint() {
      asked = false;
      const ratio = Math.min(window.devicePixelRatio || 1, 2), box = canvas.getBoundingClientRect();
      if (!box.width) return;
      canvas.width = Math.round(box.width * ratio);
      canvas.height = Math.round(box.height * ratio);
      const pen = canvas.getContext("2d");
      pen.scale(ratio, ratio);
      pen.ink = getComputedStyle(root).color;
      pen.font = "13px system-ui, sans-serif";
      draw(pen, box.width, box.height);
    }
    const ask = () => { if (!asked) { asked = true; requestAnimationFrame(paint); } };
    new ResizeObserver(ask).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", ask);
    return ask;
  }

  function mark(pen, x, y, well, faded) {
    pen.globalAlpha = faded ? 0.35 : 1;
    pen.lineWidth = 1.5;
    pen.strokeStyle = "#000";
    pen.fillStyle = well ? "#E69F00" : "#fff";
    pen.beginPath();
    if (well) pen.arc(x, y, 5.5, 0, 7);
    else for (const [a, b] of [[0, -6.5], [6.5, 0], [0, 6.5], [-6.5, 0]]) pen.lineTo(x + a, y + b);
    pen.closePath();
    pen.fill();
    pen.stroke();
    if (well) {
      pen.font = "bold 14px system-ui, sans-serif";
      pen.lineWidth = 3.5;
      pen.strokeStyle = "#fff";
      pen.fillStyle = "#000";
      pen.strokeText(well, x - 5, y - 10);
      pen.fillText(well, x - 5, y - 10);
      pen.font = "13px system-ui, sans-serif";
    }
    pen.globalAlpha = 1;
  }

  /* The surface on which U has one value: each cell of the grid in six tetrahedra, each cut by a plane. */

  const CORNERS = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]];
  const TETRAHEDRA = [[0, 5, 1, 6], [0, 1, 2, 6], [0, 2, 3, 6], [0, 3, 7, 6], [0, 7, 4, 6], [0, 4, 5, 6]];

  function surface(level, hop) {
    const triangles = [], n = size, u = new Array(8), p = new Array(8);
    const last = n.map(m => Math.floor((m - 1) / hop) * hop);
    for (let i = 0; i < last[0]; i += hop) for (let j = 0; j < last[1]; j += hop) for (let k = 0; k < last[2]; k += hop) {
      let below = 0, known = true;
      for (let c = 0; c < 8; c++) {
        const q = CORNERS[c], a = i + hop * q[0], b = j + hop * q[1], e = k + hop * q[2];
        u[c] = grid[a * stride[0] + b * stride[1] + e * stride[2]];
        if (u[c] === UNKNOWN) { known = false; break; }
        if (u[c] < level) below++;
        p[c] = [2 * a / (n[0] - 1) - 1, 2 * b / (n[1] - 1) - 1, 2 * e / (n[2] - 1) - 1];
      }
      if (!known || below === 0 || below === 8) continue;
      for (const four of TETRAHEDRA) {
        const inside = four.filter(c => u[c] < level), outside = four.filter(c => u[c] >= level);
        if (!inside.length || !outside.length) continue;
        const cut = (a, b) => {
          const t = (level - u[a]) / (u[b] - u[a]);
          return [0, 1, 2].map(m => p[a][m] + t * (p[b][m] - p[a][m]));
        };
        if (inside.length === 1) triangles.push(outside.map(o => cut(inside[0], o)));
        else if (outside.length === 1) triangles.push(inside.map(o => cut(o, outside[0])));
        else {
          const q = [cut(inside[0], outside[0]), cut(inside[0], outside[1]), cut(inside[1], outside[1]), cut(inside[1], outside[0])];
          triangles.push([q[0], q[1], q[2]], [q[0], q[2], q[3]]);
        }
      }
    }
    return triangles;
  }

  // Of two states U itself is the third direction.
  function relief(hop) {
    const faces = [], n = size, height = q => 2 * Math.min(q, ABOVE) / ABOVE - 1;
    for (let i = 0; i + hop < n[0]; i += hop) for (let j = 0; j + hop < n[1]; j += hop) {
      const four = [[i, j], [i + hop, j], [i + hop, j + hop], [i, j + hop]];
      const q = four.map(([a, b]) => grid[a * stride[0] + b]);
      if (q.some(x => x >= ABOVE)) continue;
      const face = four.map(([a, b], m) => [2 * a / (n[0] - 1) - 1, 2 * b / (n[1] - 1) - 1, height(q[m])]);
      face.share = (q[0] + q[1] + q[2] + q[3]) / 4 / 253;
      faces.push(face);
    }
    return faces;
  }

  function solid() {
    const canvas = find("solid"), turn = find("turn"), tilt = find("tilt"), level = find("level");
    const kept = {};
    let quick = false;
    const flat = d === 2;
    const hop = () => (quick ? 2 : 1);
    function faces() {
      const key = (flat ? "" : level.value) + "/" + hop();
      if (!kept[key]) {
        for (const old of Object.keys(kept)) if (Object.keys(kept).length > 3) delete kept[old];
        kept[key] = flat ? relief(hop()) : surface(Number(level.value) / 1000 * 253 + 0.001, hop());
      }
      return kept[key];
    }
    const ask = painter(canvas, (pen, width, height) => {
      const a = Number(turn.value) * Math.PI / 180, b = Number(tilt.value) * Math.PI / 180;
      const [ca, sa, cb, sb] = [Math.cos(a), Math.sin(a), Math.cos(b), Math.sin(b)];
      const zoom = Math.min(width, height) / 3.7;
      const show = ([x, y, z]) => {
        const u = ca * x - sa * y, v = sa * x + ca * y;
        return [width / 2 + zoom * u, height / 2 - zoom * (cb * z + sb * v), cb * v - sb * z];
      };
      const place = (state, u) => {
        const x = state.slice(0, 3).map((one, k) => 2 * scale(k, one) - 1);
        return flat ? [x[0], x[1], 2 * (u - data.low) / (data.high - data.low) - 1] : x;
      };
      // The frame behind the surface.
      pen.strokeStyle = pen.ink;
      pen.fillStyle = pen.ink;
      pen.globalAlpha = 0.3;
      pen.lineWidth = 1;
      for (let c = 0; c < 8; c++) for (let m = 0; m < 3; m++) if (!CORNERS[c][m]) {
        const from = CORNERS[c].map(x => 2 * x - 1), to = from.slice();
        to[m] = 1;
        const [x, y] = show(from), [s, t] = show(to);
        pen.beginPath();
        pen.moveTo(x, y);
        pen.lineTo(s, t);
        pen.stroke();
      }
      pen.globalAlpha = 1;
      const names = flat ? [...data.labels, data.energy] : data.labels;
      const limits = flat ? [...data.box, [data.low, data.high]] : data.box;
      for (let m = 0; m < 3; m++) {
        // Each name at the edge of the frame that is nearest to the reader and lowest.
        let best = null;
        for (const s of [-1, 1]) for (const t of [-1, 1]) {
          const ends = [-1, 0, 1].map(x => { const p = [s, t]; p.splice(m, 0, x); return show(p); });
          const out = m < 2 ? ends[1][1] : -ends[1][0];
          if (best === null || out > best.out) best = { ends, out };
        }
        const [low, middle, high] = best.ends, shift = m < 2 ? 16 : 0;
        pen.textAlign = m < 2 ? "center" : "right";
        const put = (text, p, extra) => pen.fillText(text, p[0] - (m < 2 ? 0 : 6), p[1] + shift + extra);
        // Not quite at the corners, where two edges meet.
        const near = end => [0, 1].map(k => 0.76 * end[k] + 0.24 * middle[k]);
        put(number(limits[m][0]), near(low), 0);
        put(number(limits[m][1]), near(high), 0);
        put(names[m], middle, m < 2 ? 14 : 0);
      }
      pen.textAlign = "left";
      const drawn = faces().map(face => {
        const corners = face.map(show);
        const [p, q, r] = corners;
        const nx = (q[1] - p[1]) * (r[2] - p[2]) - (q[2] - p[2]) * (r[1] - p[1]);
        const ny = (q[2] - p[2]) * (r[0] - p[0]) - (q[0] - p[0]) * (r[2] - p[2]);
        const nz = (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]);
        // Depth is not stretched by the zoom: its two products are smaller by it.
        const facing = Math.abs(nz) / Math.hypot(nx * zoom, ny * zoom, nz || 1e-9);
        const share = face.share === undefined ? Number(level.value) / 1000 : face.share;
        return { corners, far: corners.reduce((s, c) => s + c[2], 0), shade: 0.55 + 0.45 * facing, share };
      }).sort((one, other) => other.far - one.far);
      pen.globalAlpha = flat ? 1 : 0.6;
      for (const face of drawn) {
        pen.fillStyle = "rgb(" + colour(face.share).map(c => Math.round(c * face.shade)).join() + ")";
        pen.beginPath();
        for (const c of face.corners) pen.lineTo(c[0], c[1]);
        pen.closePath();
        pen.fill();
      }
      pen.globalAlpha = 1;
      for (const way of data.ways) for (const [line, look] of [[way.uphill, "#D55E00"], [way.downhill, "#000"]]) {
        if (!line.length) continue;
        const path = new Path2D();
        line.forEach((one, m) => {
          const [x, y] = show(place(one, flat ? energy(value(one)) : 0));
          if (!flat || isFinite(y)) path[m ? "lineTo" : "moveTo"](x, y);
        });
        pen.strokeStyle = "#fff";
        pen.lineWidth = 4;
        pen.stroke(path);
        pen.strokeStyle = look;
        pen.lineWidth = 2;
        pen.setLineDash(look === "#000" ? [4, 3] : []);
        pen.stroke(path);
        pen.setLineDash([]);
      }
      for (const one of data.saddles) mark(pen, ...show(place(one.position, one.U)).slice(0, 2), "", false);
      for (const one of data.wells) mark(pen, ...show(place(one.position, one.U)).slice(0, 2), one.label, false);
      if (!flat) find("level-said").textContent = number(energy(Number(level.value) / 1000 * 253)) + " " + data.unit;
    });
    const settle = () => { if (quick) { quick = false; ask(); } };
    for (const one of [turn, tilt, level].filter(Boolean)) {
      one.addEventListener("input", () => { quick = true; ask(); });
      one.addEventListener("change", settle);
    }
    canvas.addEventListener("pointerdown", start => {
      const [x, y, a, b] = [start.clientX, start.clientY, Number(turn.value), Number(tilt.value)];
      canvas.setPointerCapture(start.pointerId);
      const move = now => {
        quick = true;
        turn.value = ((a + 0.5 * (now.clientX - x) + 540) % 360) - 180;
        tilt.value = b + 0.4 * (now.clientY - y);
        ask();
      };
      const end = () => {
        canvas.removeEventListener("pointermove", move);
        settle();
      };
      canvas.addEventListener("pointermove", move);
      canvas.addEventListener("pointerup", end, { once: true });
      canvas.addEventListener("pointercancel", end, { once: true });
    });
  }

  /* A section: two states are the axes, the others are held. */

  function section() {
    const canvas = find("section"), across = find("across"), upwards = find("upwards");
    const held = data.pass.slice();
    const axes = () => [Number(across.value), Number(upwards.value)];
    const image = document.createElement("canvas");
    let pointer = null;
    const frame = (width, height) => ({ left: 58, top: 12, wide: width - 70, high: height - 58 });
    const ask = painter(canvas, (pen, width, height) => {
      const [i, j] = axes(), { left, top, wide, high } = frame(width, height), n = 120;
      image.width = image.height = n;
      const brush = image.getContext("2d"), pixels = brush.createImageData(n, n), place = held.slice();
      for (let row = 0; row < n; row++) for (let column = 0; column < n; column++) {
        place[i] = data.box[i][0] + (column + 0.5) / n * (data.box[i][1] - data.box[i][0]);
        place[j] = data.box[j][1] - (row + 0.5) / n * (data.box[j][1] - data.box[j][0]);
        const u = value(place), at = 4 * (row * n + column);
        if (isNaN(u)) continue;
        const band = Math.min(Math.floor(u / 253 * data.bands), data.bands) / data.bands;
        colour(band).forEach((c, k) => { pixels.data[at + k] = c; });
        pixels.data[at + 3] = 255;
      }
      brush.putImageData(pixels, 0, 0);
      pen.imageSmoothingEnabled = true;
      pen.drawImage(image, left, top, wide, high);
      pen.strokeStyle = pen.fillStyle = pen.ink;
      pen.lineWidth = 1;
      pen.strokeRect(left, top, wide, high);
      const x = v => left + scale(i, v) * wide, y = v => top + (1 - scale(j, v)) * high;
      pen.textAlign = "center";
      for (const v of ticks(data.box[i])) pen.fillText(number(v), x(v), top + high + 18);
      pen.textAlign = "right";
      for (const v of ticks(data.box[j])) pen.fillText(number(v), left - 6, y(v) + 4);
      pen.textAlign = "center";
      pen.fillText(data.labels[i], left + wide / 2, top + high + 38);
      pen.save();
      pen.translate(14, top + high / 2);
      pen.rotate(-Math.PI / 2);
      pen.fillText(data.labels[j], 0, 0);
      pen.restore();
      pen.textAlign = "left";
      // What lies farther from the plane than a tenth of the range is faded.
      const off = one => one.position.some((v, k) => k !== i && k !== j && Math.abs(scale(k, v) - scale(k, held[k])) > 0.1);
      for (const one of data.saddles) mark(pen, x(one.position[i]), y(one.position[j]), "", off(one));
      for (const one of data.wells) mark(pen, x(one.position[i]), y(one.position[j]), one.label, off(one));
      let said = "Point at the map to read U.";
      if (pointer) {
        place[i] = pointer[0];
        place[j] = pointer[1];
        const u = value(place);
        const where = data.names[i] + " = " + number(place[i]) + ", " + data.names[j] + " = " + number(place[j]);
        said = where + ": " + (isNaN(u) ? "U is not known" : u > 253 ? "U is above " + number(data.high) + " " + data.unit
          : "U is about " + number(energy(u)) + " " + data.unit);
      }
      find("read").textContent = said;
    });
    function sliders() {
      const [i, j] = axes();
      root.querySelectorAll("[data-held]").forEach(one => {
        const k = Number(one.dataset.held), label = one.closest("label");
        label.hidden = k === i || k === j;
        one.value = 1000 * scale(k, held[k]);
        label.querySelector("output").textContent = number(held[k]) + " " + data.units[k];
      });
    }
    root.querySelectorAll("[data-held]").forEach(one => one.addEventListener("input", () => {
      const k = Number(one.dataset.held);
      held[k] = data.box[k][0] + one.value / 1000 * (data.box[k][1] - data.box[k][0]);
      sliders();
      ask();
    }));
    for (const [one, other] of [[across, upwards], [upwards, across]]) {
      if (one) one.addEventListener("change", () => {
        if (one.value === other.value) other.value = [...other.options].find(o => o.value !== one.value).value;
        sliders();
        ask();
      });
    }
    root.querySelectorAll("[data-through]").forEach(one => one.addEventListener("click", () => {
      const target = one.dataset.through === "pass" ? data.pass : data.wells[Number(one.dataset.through)].position;
      target.forEach((v, k) => { held[k] = v; });
      sliders();
      ask();
    }));
    canvas.addEventListener("pointermove", now => {
      const box = canvas.getBoundingClientRect(), { left, top, wide, high } = frame(box.width, box.height), [i, j] = axes();
      const s = (now.clientX - box.left - left) / wide, t = 1 - (now.clientY - box.top - top) / high;
      pointer = s < 0 || s > 1 || t < 0 || t > 1 ? null : [
        data.box[i][0] + s * (data.box[i][1] - data.box[i][0]), data.box[j][0] + t * (data.box[j][1] - data.box[j][0])];
      ask();
    });
    canvas.addEventListener("pointerleave", () => { pointer = null; ask(); });
    sliders();
  }

  root.querySelector("[data-part='controls']").hidden = false;
  solid();
  section();
}());
