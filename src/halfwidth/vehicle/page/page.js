"use strict";
(() => {
  const SVG = "http://www.w3.org/2000/svg";
  const $ = (id) => document.getElementById(id);
  const data = JSON.parse($("data").textContent);
  const sums = (list, scale) => {
    let total = 0;
    return list.map((step) => (step === null ? NaN : (total += step) * scale));
  };
  const t = sums(data.t, 1e-3), x = sums(data.x, 1), y = sums(data.y, 1);
  const scaled = (list, scale) => list.map((value) => (value === null ? NaN : value * scale));
  const east = scaled(data.e, 0.01), north = scaled(data.n, 0.01);
  const speed = scaled(data.v, 0.01), azimuth = scaled(data.a, 0.1), since = scaled(data.s, 0.1);
  const quality = [];
  for (const [kind, count] of data.q) for (let k = 0; k < count; k++) quality.push(kind);
  const last = t.length - 1;
  const map = $("map"), frame = $("frame"), slider = $("when"), readout = $("now"), tip = $("tip");
  const drawn = { x: data.view[0], y: data.view[1], w: data.view[2], h: data.view[3] };
  let whole = drawn, view = drawn;
  let span = [t[0], Math.max(t[last], t[0] + 1e-6)];
  let current = 0;

  // ---- the map: looking closer -------------------------------------------------------------------
  const round = (size) => {
    const power = 10 ** Math.floor(Math.log10(size));
    return power * [1, 2, 5, 10].find((k) => k * power >= size * (1 - 1e-9));
  };
  const metres = (length) => (length >= 1000 ? `${+(length / 1000).toPrecision(3)} km` : `${+length.toPrecision(3)} m`);

  function drawGrid() {
    const step = round((view.w * data.unit) / 12) / data.unit;
    const path = [];
    const a = Math.floor(view.x / step) - 2, b = Math.ceil((view.x + view.w) / step) + 2;
    const c = Math.floor(view.y / step) - 2, d = Math.ceil((view.y + view.h) / step) + 2;
    for (let k = a; k <= b; k++) path.push(`M${k * step},${c * step}V${d * step}`);
    for (let k = c; k <= d; k++) path.push(`M${a * step},${k * step}H${b * step}`);
    $("grid").setAttribute("d", path.join(""));
    $("gridsize").textContent = metres(step * data.unit);
  }

  function drawMap() {
    map.setAttribute("viewBox", `${view.x} ${view.y} ${view.w} ${view.h}`);
    drawGrid();
    const wide = view.w * data.unit, length = round(wide / 12);
    $("bar").style.width = `${(100 * length) / wide}%`;
    $("barlength").textContent = metres(length);
    for (const pin of document.querySelectorAll(".pin")) {
      const [px, py] = data.pins[pin.dataset.gap];
      const left = (100 * (px - view.x)) / view.w, top = (100 * (py - view.y)) / view.h;
      pin.style.left = `${left}%`;
      pin.style.top = `${top}%`;
      pin.classList.toggle("hide", left < 0 || left > 100 || top < 0 || top > 100);
    }
    drawTip();
  }

  function drawTip() {
    const left = (100 * (x[current] - view.x)) / view.w, top = (100 * (y[current] - view.y)) / view.h;
    tip.classList.toggle("hide", left < 0 || left > 100 || top < 0 || top > 100);
    tip.textContent = `${clock(current).split(" (")[0]} · ± ${Math.max(east[current], north[current]).toFixed(2)} m`;
    // below the place and to its right, or wherever there is room
    const box = map.getBoundingClientRect();
    const px = (left / 100) * box.width, py = (top / 100) * box.height;
    const below = py + 18 + tip.offsetHeight < box.height - 4;
    tip.style.left = `${Math.max(Math.min(px + 14, box.width - tip.offsetWidth - 4), 4)}px`;
    tip.style.top = `${below ? py + 18 : py - 18 - tip.offsetHeight}px`;
  }

  // the whole drive in whatever shape the map has on this screen
  function fit() {
    const box = map.getBoundingClientRect();
    if (!box.width || !box.height) return;
    const w = Math.max(drawn.w, (drawn.h * box.width) / box.height), h = (w * box.height) / box.width;
    const same = view === whole;
    whole = { x: drawn.x + (drawn.w - w) / 2, y: drawn.y + (drawn.h - h) / 2, w, h };
    if (same) { view = whole; drawMap(); } else look(view);
  }

  function look(next) {
    const least = 4 / data.unit; // no closer than four metres
    const w = Math.min(Math.max(next.w, least), 4 * whole.w);
    const h = (w * whole.h) / whole.w;
    view = { x: next.x + (next.w - w) / 2, y: next.y + (next.h - h) / 2, w, h };
    drawMap();
  }

  // about the marked place if it is in sight, else about the middle
  const middle = () => {
    const dx = x[current] - view.x, dy = y[current] - view.y;
    return dx > 0 && dx < view.w && dy > 0 && dy < view.h ? [x[current], y[current]] : [view.x + view.w / 2, view.y + view.h / 2];
  };

  function zoom(factor, cx = middle()[0], cy = middle()[1]) {
    const w = Math.min(Math.max(view.w * factor, 4 / data.unit), 4 * whole.w);
    const real = w / view.w;
    look({ x: cx - (cx - view.x) * real, y: cy - (cy - view.y) * real, w, h: view.h * real });
  }

  const move = (dx, dy) => look({ ...view, x: view.x + dx * view.w, y: view.y + dy * view.h });

  function showGap(number) {
    const [a, b] = data.gaps[number];
    let x0 = Infinity, x1 = -Infinity, y0 = Infinity, y1 = -Infinity;
    for (let k = a; k <= b; k++) {
      const reach = Math.max(east[k], north[k]) / data.unit;
      x0 = Math.min(x0, x[k] - reach); x1 = Math.max(x1, x[k] + reach);
      y0 = Math.min(y0, y[k] - reach); y1 = Math.max(y1, y[k] + reach);
    }
    const aspect = whole.w / whole.h;
    const w = 1.35 * Math.max(x1 - x0, (y1 - y0) * aspect, 10 / data.unit);
    look({ x: (x0 + x1) / 2 - w / 2, y: (y0 + y1) / 2 - w / aspect / 2, w, h: w / aspect });
    const margin = Math.max(0.5 * (t[b] - t[a]), 5);
    drawCharts(Math.max(t[0], t[a] - margin), Math.min(t[last], t[b] + margin));
    // where it is known worst
    let worst = a;
    for (let k = a; k <= b; k++) if (Math.max(east[k], north[k]) > Math.max(east[worst], north[worst])) worst = k;
    point(worst);
    shown = number;
  }
  let shown = -1;

  function showAll() {
    view = whole;
    drawMap();
    drawCharts(t[0], t[last]);
    shown = -1;
  }

  const nextGap = (step) => {
    if (data.gaps.length) showGap((shown + step + data.gaps.length + (shown < 0 && step < 0 ? 1 : 0)) % data.gaps.length);
  };

  // ---- one moment, in the map, in the charts and in words ------------------------------------------
  const names = ["N", "NE", "E", "SE", "S", "SW", "W", "NW"];
  const words = { f: "fix", b: "bridged", x: "extrapolated" };
  const clock = (k) => {
    const plain = `${(t[k] - data.zero).toFixed(1)} s`;
    if (data.epoch === null) return plain;
    return `${plain} (${new Date(1000 * (data.epoch + t[k])).toISOString().slice(11, 19)} UTC)`;
  };

  function say(k) {
    const lat = data.lat - (y[k] * data.unit) / data.northm, lon = data.lon + (x[k] * data.unit) / data.eastm;
    const wrapped = ((((lon + 180) % 360) + 360) % 360) - 180;
    const parts = [clock(k), words[quality[k]]];
    if (quality[k] !== "f" && since[k] === since[k]) parts[1] += `, ${since[k].toFixed(1)} s since the last fix`;
    parts.push(`± ${east[k].toFixed(2)} m east, ± ${north[k].toFixed(2)} m north`);
    parts.push(`${lat.toFixed(6)}°, ${wrapped.toFixed(6)}°`);
    if (speed[k] === speed[k]) parts.push(`${speed[k].toFixed(1)} m/s`);
    if (azimuth[k] === azimuth[k]) parts.push(`${azimuth[k].toFixed(0)}° ${names[Math.round(azimuth[k] / 45) % 8]}`);
    return parts.join(" · ");
  }

  function point(k) {
    current = Math.min(Math.max(k, 0), last);
    $("here").setAttribute("d", `M${x[current]},${y[current]}h0`);
    const w = east[current] / data.unit, h = north[current] / data.unit, box = $("box");
    box.setAttribute("x", x[current] - w); box.setAttribute("y", y[current] - h);
    box.setAttribute("width", 2 * w); box.setAttribute("height", 2 * h);
    const text = say(current);
    readout.textContent = text;
    slider.value = String(current);
    slider.setAttribute("aria-valuetext", text);
    drawTip();
    drawNow();
  }

  function nearest(px, py) {
    let best = 0, least = Infinity;
    for (let k = 0; k <= last; k++) {
      const distance = (x[k] - px) ** 2 + (y[k] - py) ** 2;
      if (distance < least) { least = distance; best = k; }
    }
    return best;
  }

  function at(time) {
    let a = 0, b = last;
    while (b - a > 1) { const m = (a + b) >> 1; if (t[m] <= time) a = m; else b = m; }
    return time - t[a] < t[b] - time ? a : b;
  }

  // ---- pointer, wheel and keys on the map ---------------------------------------------------------
  const where = (event) => {
    const box = map.getBoundingClientRect();
    return [view.x + ((event.clientX - box.left) / box.width) * view.w, view.y + ((event.clientY - box.top) / box.height) * view.h];
  };
  const held = new Map();
  let spread = 0;
  map.addEventListener("pointerdown", (event) => {
    map.setPointerCapture(event.pointerId);
    held.set(event.pointerId, event);
    map.classList.add("held");
    frame.focus({ preventScroll: true });
  });
  map.addEventListener("pointermove", (event) => {
    const before = held.get(event.pointerId);
    if (!before) { point(nearest(...where(event))); return; }
    const box = map.getBoundingClientRect();
    if (held.size === 1) move(-(event.clientX - before.clientX) / box.width, -(event.clientY - before.clientY) / box.height);
    held.set(event.pointerId, event);
    if (held.size === 2) {
      const [a, b] = [...held.values()];
      const now = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
      if (spread) {
        const middle = where({ clientX: (a.clientX + b.clientX) / 2, clientY: (a.clientY + b.clientY) / 2 });
        zoom(spread / Math.max(now, 1), ...middle);
      }
      spread = now;
    }
  });
  for (const name of ["pointerup", "pointercancel"]) {
    map.addEventListener(name, (event) => {
      held.delete(event.pointerId);
      spread = 0;
      if (!held.size) map.classList.remove("held");
    });
  }
  map.addEventListener("dblclick", (event) => zoom(0.5, ...where(event)));
  map.addEventListener("wheel", (event) => {
    // an unheld wheel scrolls the page; after a click on the map, or with Ctrl, it zooms
    if (!event.ctrlKey && document.activeElement !== frame) return;
    event.preventDefault();
    zoom(1.0015 ** event.deltaY, ...where(event));
  }, { passive: false });
  const keys = {
    ArrowLeft: () => move(-0.12, 0), ArrowRight: () => move(0.12, 0), ArrowUp: () => move(0, -0.12), ArrowDown: () => move(0, 0.12),
    "+": () => zoom(0.7), "=": () => zoom(0.7), "-": () => zoom(1 / 0.7), 0: showAll, n: () => nextGap(1), p: () => nextGap(-1),
    ",": () => point(current - 1), ".": () => point(current + 1),
  };
  frame.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target !== frame || !keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
  const buttons = { closer: keys["+"], wider: keys["-"], all: showAll, next: keys.n, previous: keys.p };
  for (const [id, action] of Object.entries(buttons)) $(id).addEventListener("click", action);
  for (const button of document.querySelectorAll("[data-gap]")) {
    button.addEventListener("click", () => {
      showGap(Number(button.dataset.gap));
      if (!frame.contains(button)) frame.scrollIntoView({ block: "center" });
    });
  }
  for (const box of document.querySelectorAll("[data-layer]")) {
    box.addEventListener("change", () => $(box.dataset.layer).classList.toggle("hide", !box.checked));
  }
  slider.addEventListener("input", () => point(Number(slider.value)));

  // ---- the charts: looking at less time -----------------------------------------------------------
  const W = 2000, H = 400;
  const charts = [...document.querySelectorAll(".plot[data-chart]")].map((plot) => ({ plot, svg: plot.querySelector("svg"), ...data.charts[plot.dataset.chart] }));
  const series = { speed, azimuth, east, north };

  function path(values, low, high, wraps, a, b) {
    const out = [];
    let pen = "M", before = NaN;
    const scale = W / (span[1] - span[0]);
    for (let k = a; k <= b; k++) {
      if (values[k] !== values[k]) { pen = "M"; continue; }
      if ((wraps && Math.abs(values[k] - before) > 180) || (k > a && t[k] - t[k - 1] > data.pause)) pen = "M";
      before = values[k];
      out.push(`${pen}${((t[k] - span[0]) * scale).toFixed(1)},${(H - ((Math.min(Math.max(before, low), high) - low) / (high - low)) * H).toFixed(1)}`);
      pen = "L";
    }
    return out.join("");
  }

  function ticks(low, high) {
    const round60 = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600].find((step) => (high - low) / step <= 10);
    const step = round60 && high - low > 8 ? round60 : round((high - low) / 8);
    const out = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9; k++) out.push(k * step);
    return out;
  }

  function drawCharts(from, to) {
    span = [from, Math.max(to, from + 0.5)];
    const a = Math.max(at(span[0]) - 1, 0), b = Math.min(at(span[1]) + 1, last);
    const full = from <= t[0] && to >= t[last];
    for (const chart of charts) {
      for (const [name, id] of chart.lines) {
        const line = $(id);
        if (!line.dataset.whole) line.dataset.whole = line.getAttribute("d");
        line.setAttribute("d", full ? line.dataset.whole : path(series[name], chart.low, chart.high, name === "azimuth", a, b));
      }
      for (const shade of chart.svg.querySelectorAll("[data-from]")) {
        const [u, v] = [shade.dataset.from, shade.dataset.to].map((s) => ((Number(s) - span[0]) / (span[1] - span[0])) * W);
        shade.setAttribute("x", u);
        shade.setAttribute("width", Math.max(v - u, 1));
      }
      for (const raw of chart.svg.querySelectorAll(".raw")) raw.classList.toggle("hide", !full);
    }
    for (const axis of document.querySelectorAll(".plot[data-chart] .axis")) {
      axis.replaceChildren(...ticks(span[0] - data.zero, span[1] - data.zero).map((value, k) => {
        const label = document.createElement("span");
        label.className = k % 2 ? "tx odd" : "tx";
        label.style.left = `${(100 * (value + data.zero - span[0])) / (span[1] - span[0])}%`;
        label.textContent = String(+value.toFixed(3));
        return label;
      }));
    }
    drawNow();
  }

  function drawNow() {
    const u = ((t[current] - span[0]) / (span[1] - span[0])) * W;
    for (const chart of charts) {
      if (!chart.now) {
        chart.now = document.createElementNS(SVG, "path");
        chart.now.setAttribute("class", "now");
        chart.svg.append(chart.now);
      }
      chart.now.setAttribute("d", `M${u},0V${H}`);
    }
  }
  for (const chart of charts) {
    chart.plot.addEventListener("pointermove", (event) => {
      const box = chart.svg.getBoundingClientRect();
      point(at(span[0] + ((event.clientX - box.left) / box.width) * (span[1] - span[0])));
    });
  }

  for (const live of document.querySelectorAll(".live")) live.classList.remove("hide");
  point(data.worst);
  drawMap();
  fit();
  new ResizeObserver(fit).observe(map);
  document.documentElement.dataset.ready = "yes";
})();
