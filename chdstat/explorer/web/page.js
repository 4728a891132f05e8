// The page's half of the explorer: turns what a person does into commands, and what the server
// says into text. It computes nothing. All text from the server is set as text, never as markup.
window.chdstat = (() => {
  "use strict";
  let models = null, sent = 0, view = null, label = null;
  const timings = [];
  const $ = (query) => document.querySelector(query);
  const all = (query) => [...document.querySelectorAll(query)];
  const make = (tag, text, attributes = {}) => {
    const element = document.createElement(tag);
    if (text !== null && text !== undefined) element.textContent = text;
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    return element;
  };
  const swatch = (color) => { const i = make("i"); i.style.background = color; return i; };

  function send(command, options = {}) {
    sent += 1;
    if (["pick", "move", "box", "activate"].includes(command)) {
      timings.push({ seq: sent, start: performance.now() });
    }
    models.inbox.value = JSON.stringify({ seq: sent, command, ...options });
    return sent;
  }

  // --- the image ---
  const inside = (x, y) => x >= 0 && y >= 0 && x < models.width && y < models.height;

  function tap(event) {
    const [x, y] = [Math.floor(event.x), Math.floor(event.y)];
    send("pick", { y, x, add: Boolean(event.modifiers && event.modifiers.shift) });
  }

  // Bokeh takes a press that is held for long for no click, and its drag for no drag.
  let pressed = null;
  const press = (event) => { pressed = event; };
  function pressup(event) {
    const from = pressed ?? event;
    pressed = null;
    if (Math.hypot(event.sx - from.sx, event.sy - from.sy) < 4) tap(event);
    else if (models.boxes[0].active) send("box", { box: [from.y, from.x, event.y, event.x] });
    else {
      shift(models.x_range, from.x - event.x);
      shift(models.y_range, from.y - event.y);
    }
  }

  const shift = (range, by) => range.setv({ start: range.start + by, end: range.end + by });

  function box(event) {
    const g = event.geometry;
    if (!event.final || g.type !== "rect") return;
    send("box", { box: [g.y0, g.x0, g.y1, g.x1] });
  }

  function number(value) {
    if (!Number.isFinite(value)) return "none";
    if (value === 0) return "0";
    const size = Math.abs(value);
    return size >= 1e-3 && size < 1e5 ? value.toPrecision(4) : value.toExponential(2);
  }

  // Samples are stored in blocks: where the pointer rests on another one, it is read ahead.
  let block = "", resting = 0;
  function near(y, x) {
    const here = `${y >> 4} ${x >> 4}`;
    if (here === block) return;
    clearTimeout(resting);
    resting = setTimeout(() => { block = here; send("near", { y, x }); }, 30);
  }

  function hover(event) {
    const [x, y] = [Math.floor(event.x), Math.floor(event.y)];
    if (!inside(x, y)) { $("#readout").textContent = "outside the image"; return; }
    near(y, x);
    const at = y * models.width + x, data = models.radiance.data;
    const parts = models.channels.map((c) => `${c} ${number(data[c][0][at])}`);
    let text = `y ${y}  x ${x}  ·  ${parts.join("  ")}`;
    if (label) {
      const value = models.map.data.image[0][at];
      const word = label.names ? (label.names[value] ?? "none") : number(value);
      text += `  ·  ${label.title}: ${word}`;
    }
    $("#readout").textContent = text;
  }

  function zoom(how) {
    const [xr, yr] = [models.x_range, models.y_range];
    if (how === "reset") {
      xr.setv({ start: 0, end: models.width });
      yr.setv({ start: models.height, end: 0 });
      return;
    }
    const factor = how === "in" ? 0.7 : 1 / 0.7;
    for (const r of [xr, yr]) {
      const middle = (r.start + r.end) / 2, half = (r.end - r.start) / 2 * factor;
      r.setv({ start: middle - half, end: middle + half });
    }
  }

  function drag(how) {
    for (const tool of models[how === "box" ? "boxes" : "pans"]) tool.active = true;
    for (const tool of models[how === "box" ? "pans" : "boxes"]) tool.active = false;
    for (const b of all("[data-drag]")) b.setAttribute("aria-pressed", String(b.dataset.drag === how));
  }

  const ARROWS = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };

  function key(event) {
    const target = event.composedPath()[0];
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    if (target.closest && target.closest("input, select, textarea")) return;
    if (event.key in ARROWS) {
      const [dy, dx] = ARROWS[event.key], step = event.shiftKey ? 10 : 1;
      send("move", { dy: dy * step, dx: dx * step });
    } else if (event.key === "+" || event.key === "=") zoom("in");
    else if (event.key === "-") zoom("out");
    else if (event.key === "0") zoom("reset");
    else if (event.key === "b") drag("box");
    else if (event.key === "p") drag("pan");
    else return;
    event.preventDefault();
  }

  // --- what the server says ---
  const says = {
    view(item) {
      const selected = JSON.stringify([item.view.pixels, item.view.active, item.view.region]);
      if (selected !== asked) { asked = selected; untested(); }
      view = item.view;
      const query = item.query ? `?${item.query}` : location.pathname;
      history.replaceState(null, "", query);
      for (const s of all("select[data-option]")) s.value = String(view[s.dataset.option]);
      for (const c of all("[data-family]")) c.checked = view.families.includes(c.dataset.family);
      const automatic = view.exposure === null;
      $("#exposure").value = automatic ? item.exposure : view.exposure;
      $("#stops").textContent = `${item.exposure >= 0 ? "+" : "−"}${Math.abs(item.exposure).toFixed(2)}`;
      $("#auto").setAttribute("aria-pressed", String(automatic));
      marks(item.colors);
      chips(item.colors);
      const nothing = !view.pixels.length && !view.region;
      document.body.classList.toggle("nothing", nothing);
      if (nothing) for (const q of [".table:not(#goodness)", ".panel .note", "#legend"]) for (const e of all(q)) e.replaceChildren();
    },
    panels(item) {
      draw(item);
      for (const [name, notes] of Object.entries(item.notes)) $(`#note-${name}`).textContent = notes.join("  |  ");
      $("#legend").replaceChildren(...item.legend.map(([text, color]) => {
        const s = make("span"); s.append(swatch(color), text); return s;
      }));
    },
    tables(item) {
      for (const [name, content] of Object.entries(item.tables)) table($(`#${name}`), content);
      if ("compared" in item.tables) $("#compared").hidden = false;
    },
    goodness(item) {
      const bar = $("#goodness progress");
      if (bar) bar.value = item.share;
    },
    colorbar(item) { colorbar(item.bar); },
    described(item) { $("#described").textContent = item.text; },
    working(item) { $("#working").textContent = item.text; },
    alert(item) {
      $("#alert span").textContent = item.text;
      $("#alert").hidden = !item.text;
    },
    live(item) {
      $("#live").hidden = !item.shown;
      if (!item.shown) return;
      $("#live progress").value = item.share;
      $("#live span").textContent = item.text;
      $("#live button").textContent = item.paused ? "Continue" : "Pause";
      $("#live button").hidden = item.share >= 1;
    },
    file(item) {
      const bytes = Uint8Array.from(atob(item.data), (c) => c.charCodeAt(0));
      const url = URL.createObjectURL(new Blob([bytes], { type: item.type }));
      const link = make("a", null, { href: url, download: item.name });
      document.body.append(link);
      link.click();
      link.remove();
      setTimeout(() => URL.revokeObjectURL(url), 10000);
    },
    done(item) {
      const timing = timings.find((t) => t.seq === item.seq);
      // Two frames later, what was drawn in the first is on the screen.
      requestAnimationFrame(() => requestAnimationFrame(() => {
        document.body.dataset.shown = String(item.seq);
        if (timing && !timing.end) {
          timing.end = performance.now();
          timing.server = item.took;
        }
      }));
    },
  };

  function receive() {
    if (!models.outbox.value) return;
    for (const item of JSON.parse(models.outbox.value).items) says[item.kind](item);
  }

  // What is drawn here is drawn from the server's numbers; it must not be sent back as a change.
  const put = (source, data) => source.setv({ data }, { sync: false });

  function marks(colors) {
    const chosen = view.pixels;
    put(models.marks, {
      x: chosen.map((p) => p[1] + 0.5), y: chosen.map((p) => p[0] + 0.5),
      color: chosen.map((_, i) => colors[i]), text: chosen.map((_, i) => (chosen.length > 1 ? String(i + 1) : "")),
    });
    const [top, left, bottom, right] = (view.region ?? [null, null, null, null]).map((v) => (v === null ? [] : [v]));
    put(models.region, { left, right, top, bottom });
  }

  function draw(item) {
    const bytes = Uint8Array.from(atob(item.numbers), (c) => c.charCodeAt(0));
    const numbers = new Float64Array(bytes.buffer);
    let at = 0;
    const take = (n) => numbers.subarray(at, (at += n));
    for (const [name, panel] of Object.entries(item.panels)) {
      const [areas, lines, lineMarks, ...ranges] = models.panels[name];
      const columns = (traces) => {
        const both = traces.map((t) => [take(t.n), take(t.n)]);
        return { xs: both.map((b) => b[0]), ys: both.map((b) => b[1]), color: traces.map((t) => t.color) };
      };
      put(areas, columns(panel.areas));
      const drawn = columns(panel.lines);
      put(lines, { ...drawn, dash: panel.lines.map((t) => t.dash), width: panel.lines.map((t) => t.width) });
      put(lineMarks, panel.marks);
      for (const [i, [start, end]] of (panel.extent ?? []).entries()) ranges[i].setv({ start, end }, { sync: false });
    }
  }

  function chips(colors) {
    const found = view.pixels.map(([y, x], i) => {
      const chip = make("span", null, { class: "chip" });
      const pick = make("button", null, { type: "button", "aria-pressed": String(i === view.active) });
      pick.append(swatch(colors[i]), `${i + 1}: y ${y} x ${x}`);
      pick.addEventListener("click", () => send("activate", { index: i }));
      const drop = make("button", "×", { type: "button", "aria-label": `Drop pixel ${i + 1}` });
      drop.addEventListener("click", () => send("drop", { index: i }));
      chip.append(pick, drop);
      return chip;
    });
    if (view.region) {
      const [t, l, b, r] = view.region;
      const chip = make("span", null, { class: "chip" });
      chip.append(make("button", `region y ${t}–${b - 1}, x ${l}–${r - 1} (${b - t} × ${r - l})`, { type: "button", "aria-pressed": "true" }));
      found.push(chip);
    }
    if (!found.length) found.push(make("span", "Nothing is selected yet.", { class: "hint" }));
    const focused = document.activeElement && document.activeElement.closest("#chips");
    const place = focused ? all("#chips button").indexOf(document.activeElement) : -1;
    $("#chips").replaceChildren(...found);
    if (place >= 0) (all("#chips button")[place] ?? $(".image")).focus();
  }

  function table(parent, content) {
    const body = make("table", null, { class: content.words ? "words" : "" });
    const head = make("tr");
    head.append(...content.columns.map((c) => make("th", c, { scope: "col" })));
    const rows = content.rows.map((cells) => {
      const row = make("tr");
      row.append(...cells.slice(0, content.columns.length).map((c) => make("td", c)));
      if (cells.length > content.columns.length) row.title = cells.at(-1);
      return row;
    });
    body.append(head, ...rows);
    const parts = [make("h2", content.title)];
    for (const text of [content.summary, content.note]) if (text) parts.push(make("p", text, { class: "note" }));
    parent.replaceChildren(...parts, body);
  }

  // The test of the fits waits to be asked for, anew for each selection.
  let asked = "", offer = null;
  function untested() {
    if (!offer) {
      offer = [...$("#goodness").children];
      $("#goodness button").addEventListener("click", () => {
        $("#goodness progress").hidden = false;
        $("#goodness button").disabled = true;
        send("goodness");
      });
    }
    $("#goodness").replaceChildren(...offer);
    $("#goodness progress").value = 0;
    $("#goodness progress").hidden = true;
    $("#goodness button").disabled = false;
  }

  function colorbar(bar) {
    label = bar && bar.names ? { title: bar.title, names: bar.names } : bar ? { title: bar.title } : null;
    const parent = $("#colorbar");
    parent.hidden = !bar;
    if (!bar) return;
    const parts = [make("span", bar.unit ? `${bar.title} (${bar.unit})` : bar.title)];
    if (bar.names) {
      const codes = make("div", null, { class: "codes" });
      codes.append(...bar.codes.map(([text, color]) => {
        const s = make("span"); s.append(swatch(color), text); return s;
      }));
      parts.push(codes);
    } else {
      const ramp = make("div", null, { class: "ramp" });
      ramp.style.background = `linear-gradient(90deg, ${bar.ramp.join(",")})`;
      const ends = make("div", null, { class: "ends" });
      ends.append(...bar.ticks.map((t) => make("span", t)));
      parts.push(ramp, ends);
    }
    parent.replaceChildren(...parts);
  }

  // --- the start ---
  // Bokeh writes a style sheet for each axis and glyph whenever it paints, mostly the same as before,
  // and asks for computed styles in between: the browser then works all styles of the page out anew.
  function spare() {
    const sheet = Bokeh.require?.("core/dom")?.InlineStyleSheet?.prototype, update = sheet?._update;
    if (update) sheet._update = function (css) { if (this.el.textContent !== css) update.call(this, css); };
  }

  function start(given) {
    models = given;
    spare();
    models.outbox.properties.value.change.connect(receive);
    receive();
    document.addEventListener("keydown", key);
    for (const p of all(".image")) p.addEventListener("pointerdown", () => p.focus({ preventScroll: true }));
    for (const s of all("select[data-option]")) s.addEventListener("change", () => {
      const value = s.dataset.option === "batch" ? Number(s.value) : s.value;
      send("set", { option: s.dataset.option, value });
    });
    for (const c of all("[data-family]")) c.addEventListener("change", () => {
      const value = all("[data-family]").filter((e) => e.checked).map((e) => e.dataset.family);
      send("set", { option: "families", value });
    });
    $("#exposure").addEventListener("input", (e) => send("set", { option: "exposure", value: Number(e.target.value) }));
    $("#auto").addEventListener("click", () => send("set", { option: "exposure", value: null }));
    for (const b of all("[data-drag]")) b.addEventListener("click", () => drag(b.dataset.drag));
    for (const b of all("[data-zoom]")) b.addEventListener("click", () => zoom(b.dataset.zoom));
    for (const b of all("[data-export]")) b.addEventListener("click", () => send("export", { format: b.dataset.export }));
    $("#live button").addEventListener("click", () => send("pause"));
    $("#alert button").addEventListener("click", () => { $("#alert").hidden = true; });
    document.addEventListener("visibilitychange", () => send("visible", { on: !document.hidden }));
    document.body.dataset.ready = "1";
    send("ready");
  }

  function lost() {
    if ($("#alert")) says.alert({ text: "The server has stopped; start 'chdstat explore' again and reload this page." });
  }

  return { start, tap, press, pressup, box, hover, lost, timings };
})();
