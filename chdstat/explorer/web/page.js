// The page's half of the explorer: turns what a person does into commands, and what the server
// says into text. It computes nothing. All text from the server is set as text, never as markup.
window.chdstat = (() => {
  "use strict";
  let models = null, sent = 0, view = null, label = null, query = "", lastMap = "null_share", drawn = null, histogram = null;
  const timings = [], RESULTS = "#headline, .panels, .tables";
  const $ = (query) => document.querySelector(query);
  const all = (query) => [...document.querySelectorAll(query)];
  const make = (tag, text, attributes = {}) => {
    const element = document.createElement(tag);
    if (text !== null && text !== undefined) element.textContent = text;
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    return element;
  };
  const swatch = (color) => { const i = make("i"); i.style.background = color; return i; };

  // --- what is fresh ---
  // What shows the selection is marked as soon as something else is asked for, until it shows that.
  const SELECTS = ["ready", "pick", "move", "box", "activate", "drop"];
  let unanswered = [], held = null, looks = [];
  const outdate = (query, on) => all(query).forEach((e) => e.setAttribute("aria-busy", String(on)));
  const freshen = (query, seq) => { if (!unanswered.some((n) => n > seq)) outdate(query, false); };
  function answered(item) {
    unanswered = unanswered.filter((n) => (item.refused ? n !== item.seq : n > item.seq));
    if (!unanswered.length) outdate(`${RESULTS}, #scores`, false);
  }
  function fail(text) {
    document.body.classList.toggle("failed", Boolean(text));
    $("#failed").textContent = text;
  }

  function send(command, options = {}) {
    sent += 1;
    if (SELECTS.includes(command) || (command === "set" && !looks.includes(options.option))) {
      unanswered.push(sent);
      outdate(RESULTS, true);
    }
    if (command === "set" && ["shown", "reference"].includes(options.option)) outdate("#scores", true);
    if (["pick", "move", "box", "activate"].includes(command)) {
      timings.push({ seq: sent, start: performance.now() });
    }
    models.inbox.value = JSON.stringify({ seq: sent, command, ...options });
    return sent;
  }

  const set = (option, value) => send("set", { option, value });

  // --- the image ---
  const inside = (x, y) => x >= 0 && y >= 0 && x < models.width && y < models.height;

  function tap(event) {
    const [x, y] = [Math.floor(event.x), Math.floor(event.y)];
    read(event, y, x);  // a finger does not point before it taps
    if (following && added) { added = false; return; }  // it is there: from here on it stays
    clearTimeout(resting);  // what is clicked is read at once: not twice side by side
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

  function number(value, digits = 4) {
    if (!Number.isFinite(value)) return "none";
    const size = Math.abs(value);
    if (value !== 0 && (size < 1e-3 || size >= 10 ** (digits + 1))) return value.toExponential(digits - 2);
    return value === 0 ? "0" : value.toPrecision(digits);
  }

  // Where the pointer rests, what a click would show is read and computed ahead.
  let rested = "", resting = 0;
  function near(y, x) {
    const here = `${y} ${x}`;
    if (here === rested) return;
    clearTimeout(resting);
    resting = setTimeout(() => { rested = here; send("near", { y, x }); }, 50);
  }

  function hover(event) {
    const [x, y] = [Math.floor(event.x), Math.floor(event.y)];
    if (!inside(x, y)) { $("#readout").textContent = "outside the image"; return; }
    near(y, x);
    if (following) followed(y, x);
    read(event, y, x);
  }

  function read(event, y, x) {
    if (!inside(x, y)) return;
    const at = y * models.width + x, which = Math.max(0, models.figures.indexOf(event.origin));
    const data = models.radiances[which].data;
    const parts = models.channels.map((c) => `${c} ${number(data[c][0][at])}`);
    let text = `y ${y}  x ${x}  ·  ${parts.join("  ")}`;
    if (label) {
      const shown = models.maps[front].data.image[0]?.[at], value = label.log ? 10 ** shown : shown;
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

  // --- several images ---
  let front = 0, back = 0, peeking = false;
  const several = () => all("figure").length > 1;
  const next = (i, by) => (i + by + all("figure").length) % all("figure").length;
  function arrange() {
    const top = peeking ? back : front, side = $("main").classList.contains("side");
    for (const [i, figure] of all("figure").entries()) {
      figure.classList.toggle("front", i === top);
      figure.classList.toggle("behind", i === back);
      figure.style.clipPath = !side && several() && i === top && i !== back ? `inset(0 0 0 ${$("#swipe").value}%)` : "";
      const role = figure.querySelector(".role");
      if (role) role.textContent = i === back ? " · reference" : "";
    }
    for (const [i, image] of all(".image").entries()) image.tabIndex = side || i === top ? 0 : -1;
    for (const b of all("[data-show]")) b.setAttribute("aria-pressed", String(Number(b.dataset.show) === top));
    if (several()) $("#reference").value = String(back);
  }
  const show = (i) => choose("shown", i), refer = (i) => choose("reference", i);
  function choose(option, i) {
    if (i >= all("figure").length || i === (option === "shown" ? front : back)) return;
    if (option === "shown") front = i; else back = i;
    arrange();
    set(option, i);
  }
  function peek(on) {
    if (!several() || on === peeking) return;
    peeking = on;
    arrange();
  }
  function side(on) {
    $("main").classList.toggle("side", on);
    $("#side").setAttribute("aria-pressed", String(on));
    $("#swiping").hidden = on;
    arrange();
    address();
  }
  function differ() {
    const names = ["image", ...[...$("select[data-option=map]").options].map((o) => o.value).filter((v) => v.startsWith("diff:"))];
    set("map", names[(names.indexOf(view.map) + 1) % names.length]);
  }

  // The pixel under the pointer beside those that are pinned: one request at a time, the latest next.
  let following = false, added = false, pending = 0, wanted = null;
  function follow(on) {
    if (!on && added) send("drop", { index: view.active });
    following = on;
    added = false;
    pending = 0;
    wanted = null;
    $("#follow").setAttribute("aria-pressed", String(on));
  }
  function followed(y, x) {
    wanted = [y, x];
    if (pending || view.pixels.some((p, i) => p[0] === y && p[1] === x && !(added && i === view.active))) return;
    const [ay, ax] = view.pixels[view.active] ?? [null, null];
    if (added && ay === y && ax === x) return;
    pending = added ? send("move", { dy: y - ay, dx: x - ax }) : send("pick", { y, x, add: true });
    added = true;
  }

  // --- what is in view ---
  const whole = () => [0, 0, models.width, models.height];
  const seen = () => [models.x_range.start, models.y_range.end, models.x_range.end, models.y_range.start];
  function address() {
    const parts = query ? [query] : [], now = seen().map((v) => Math.round(10 * v) / 10);
    if (String(now) !== String(whole())) parts.push(`z=${now}`);
    if ($("#opacity").value !== "1") parts.push(`o=${$("#opacity").value}`);
    if ($("main").classList.contains("side")) parts.push("side=1");
    history.replaceState(null, "", parts.length ? `?${parts.join("&")}` : location.pathname);
  }
  const fade = () => { for (const over of models.overs) over.setv({ global_alpha: Number($("#opacity").value) }, { sync: false }); };
  let resized = 0;
  function zoomed() {
    clearTimeout(resized);
    resized = setTimeout(() => { address(); labelPixels(); }, 150);
  }
  // Pixels that are large enough show their radiance.
  function labelPixels() {
    const [left, top, right, bottom] = seen(), edge = $(".image").clientWidth / (right - left);
    for (const [i, values] of models.values.entries()) {
      const shown = { x: [], y: [], text: [] }, data = models.radiances[i].data;
      if (edge >= 38) for (let y = Math.max(0, Math.floor(top)); y < Math.min(models.height, bottom); y++)
        for (let x = Math.max(0, Math.floor(left)); x < Math.min(models.width, right); x++) {
          shown.x.push(x + 0.5); shown.y.push(y + 0.5);
          shown.text.push(models.channels.map((c) => number(data[c][0][y * models.width + x], 3)).join("\n"));
        }
      put(values, shown);
    }
  }

  // A region without a mouse: the pixels around the selected one, and back.
  const AROUND = 4;
  function around() {
    const [y, x] = view.pixels[view.active] ?? [];
    if (view.region) {
      const [top, left, bottom, right] = view.region;
      send("pick", { y: (top + bottom - 1) >> 1, x: (left + right - 1) >> 1 });
    } else if (y !== undefined) send("box", { box: [y - AROUND, x - AROUND, y + AROUND + 1, x + AROUND + 1] });
  }

  // --- brushing: a range of radiance across a histogram, or the null samples ---
  const BRUSHED = ["log", "linear", "image"];
  const across = (name) => Bokeh.index.find_one(models.panels[name].at(-1))?.frame;
  const brushable = (name) => !$(`#panel-${name}`).hidden && models.panels[name][5].visible;
  let brushing = null;
  function brush(value) {
    if (value === null && (!view || view.brush === null)) return;
    set("brush", value);
  }
  function band(name, ends) {
    const mark = $(`#panel-${name} .brush`), frame = ends && brushable(name) ? across(name) : null;
    mark.hidden = true;
    if (!frame) return;
    const { left, right } = frame.bbox;
    const at = (v, none) => v === null ? none : v <= 0 && name !== "linear" ? -Infinity : frame.x_scale.compute(v);
    const low = Math.max(left, at(ends[0], left)), high = Math.min(right, at(ends[1], right));
    if (low > high) return;
    mark.hidden = false;
    mark.style.left = `${low}px`;
    mark.style.width = `${Math.max(1, high - low)}px`;
  }
  function bands() {
    const ends = Array.isArray(view?.brush) ? view.brush : null;
    for (const name of BRUSHED) band(name, ends);
  }
  function brushes(name) {
    const plot = $(`#panel-${name} .plot`);
    const at = (event) => {
      const { left, right } = across(name).bbox;
      return Math.min(right, Math.max(left, event.clientX - plot.getBoundingClientRect().left));
    };
    // An end at the edge of the axis is open: what lies beyond it belongs to it, too. Others have as
    // many digits as tell a pixel from the next.
    const ends = (event) => {
      const { bbox: { left, right }, x_scale: scale } = across(name);
      return [brushing, at(event)].sort((a, b) => a - b).map((sx) => {
        if (sx <= left || sx >= right) return null;
        const value = scale.invert(sx), step = Math.abs(scale.invert(sx + 1) - value);
        const digits = Math.ceil(Math.log10(Math.abs(value) / step)) + 1;
        return Number(value.toPrecision(Math.min(Math.max(digits, 3), 9) || 3));
      });
    };
    plot.addEventListener("pointerdown", (event) => {
      if (event.button || !brushable(name) || !across(name)) return;
      brushing = at(event);
      plot.setPointerCapture(event.pointerId);
      event.preventDefault();
    });
    plot.addEventListener("pointermove", (event) => {
      if (brushing !== null) band(name, ends(event));
    });
    plot.addEventListener("pointerup", (event) => {
      if (brushing === null) return;
      const found = Math.abs(at(event) - brushing) < 4 ? null : ends(event);
      brushing = null;
      if (found?.some((v) => v !== null)) { brush(found); return; }
      if (found) brush(null);
      bands();
    });
    plot.addEventListener("pointercancel", () => { brushing = null; bands(); });
  }
  function typed() {
    const fields = all("#brushing input"), value = fields.map((e) => e.value === "" ? null : e.valueAsNumber);
    if (value[0] !== null && value[1] !== null && value[0] > value[1]) {  // what was typed last holds
      const other = fields.indexOf(this) === 0 ? 1 : 0;
      fields[other].value = "";
      value[other] = null;
    }
    if (value.some((v) => v !== null)) brush(value);
    else brush(null);
  }
  function nulls() { brush(view.brush === "null" ? null : "null"); }

  const ARROWS = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };
  const LETTERS = { k: "ArrowUp", j: "ArrowDown", h: "ArrowLeft", l: "ArrowRight" };
  function channel(by) {
    const values = [...$("select[data-option=channel]").options].map((o) => o.value);
    set("channel", values[(values.indexOf(view.channel) + by + values.length) % values.length]);
  }

  function key(event) {
    const target = event.composedPath()[0];
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    if (event.key === "Escape" && brushing !== null) { brushing = null; bands(); return; }
    if (event.key === "Escape" && !$("#help").matches(":popover-open")) brush(null);
    if (target.closest?.("input, select, textarea")) return;
    if (event.key in ARROWS && target.closest?.(".right, #help")) return;  // there, they scroll
    const name = event.key.toLowerCase(), shift = event.shiftKey, digit = /^Digit([1-9])$/.exec(event.code);
    const arrow = LETTERS[name] ?? (several() ? null : event.key), [dy, dx] = ARROWS[arrow] ?? [];
    if (event.key === "Shift") { peek(true); return; }
    if (dy !== undefined) send("move", { dy: dy * (shift ? 10 : 1), dx: dx * (shift ? 10 : 1) });
    else if (event.key in ARROWS) {
      const [down, right] = ARROWS[event.key];
      if (right) channel(right);
      else if (shift) refer(next(back, down));
      else show(next(front, down));
    } else if (digit && several()) (shift ? refer : show)(Number(digit[1]) - 1);
    else if (event.key === "+" || event.key === "=") zoom("in");
    else if (event.key === "-") zoom("out");
    else if (name === "f" || event.key === "0") zoom("reset");
    else if (name === "e") set("exposure", Number($("#exposure").value) + (shift ? -0.5 : 0.5));
    else if (name === "g") set("gamma", Math.round(10 * view.gamma + (shift ? -1 : 1)) / 10);
    else if (name === "r") for (const [option, value] of [["exposure", null], ["gamma", 1], ["tone", "srgb"]]) set(option, value);
    else if (name === "c") channel(1);
    else if (name === "i") {
      const value = view.map === "image" ? lastMap : "image";
      if (value !== view.map) set("map", value);
    } else if (name === "v") follow(!following);
    else if (name === "x" && several()) { const [one, other] = [front, back]; show(other); refer(one); }
    else if (name === "s" && several()) side(!$("main").classList.contains("side"));
    else if (name === "d" && several()) differ();
    else if (name === "o") nulls();
    else if (name === "w") $("#brushing input").focus();
    else if (event.key === "?") explain("keys", $("#keys"));
    else if (name === "n") around();
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
      const first = !view;
      view = item.view;
      if (view.map !== "image") lastMap = view.map;
      if (first) [front, back] = item.images;  // from then on, the page knows it before the server
      if (first) arrange();
      query = item.query;
      address();
      // N is what the samples allow, which comes with the panels.
      for (const s of all("select[data-option]")) if (s.dataset.option !== "batch") s.value = String(view[s.dataset.option]);
      for (const c of all("[data-family]")) c.checked = view.families.includes(c.dataset.family);
      const automatic = view.exposure === null;
      $("#exposure").value = automatic ? item.exposure : view.exposure;
      $("#stops").textContent = `${item.exposure >= 0 ? "+" : "−"}${Math.abs(item.exposure).toFixed(2)}`;
      $("#auto").setAttribute("aria-pressed", String(automatic));
      $("#gamma").hidden = view.gamma === 1;
      $("#gamma").textContent = `gamma ${view.gamma}`;
      const range = Array.isArray(view.brush) ? view.brush : [null, null];
      for (const [i, e] of all("#brushing input").entries()) if (e !== document.activeElement) e.value = range[i] ?? "";
      $("#nulls").setAttribute("aria-pressed", String(view.brush === "null"));
      $("#unbrush").hidden = view.brush === null;
      limitable();
      bands();
      pixelColors = item.colors;
      marks(item.colors);
      chips(item.colors);
      const nothing = !view.pixels.length && !view.region;
      document.body.classList.toggle("nothing", nothing);
      if (nothing) fail("");
      if (nothing) for (const q of [".table:not(#goodness)", "#headline h2", "#why", "#headline dl", ".panel .note", "#legend"]) for (const e of all(q)) e.replaceChildren();
    },
    panels(item) {
      held = item.seq < 0 ? item : null;  // nobody waits: all changes at once, with the numbers
      if (held) return;
      drawn = item;
      document.body.dataset.drawn = "1";
      fail("");
      fill(item);
      freshen(".panels", item.seq);
    },
    headline(item) {
      if (held) says.panels({ ...held, seq: 0 });
      heading($("#headline h2"), item.title, "headline");
      const [label, cause] = item.label;
      $("#why").replaceChildren(named(label), `: ${cause}`);
      $("#headline dl").replaceChildren(...item.numbers.map(([title, value, detail]) => {
        const one = make("div");
        one.append(make("dt", title), make("dd", value), make("dd", detail, { class: "note" }));
        return one;
      }));
    },
    suggested(item) {
      const buttons = item.pixels.map(([name, [y, x]]) => {
        const button = make("button", name, { type: "button", title: `y ${y}, x ${x}; with shift, beside the others` });
        button.addEventListener("click", (e) => send("pick", { y, x, add: e.shiftKey }));
        return button;
      });
      $("#suggested").hidden = !buttons.length;
      $("#suggested").replaceChildren(make("span", "Worth a look", { class: "label" }), ...buttons);
    },
    scores(item) { $("#scores").textContent = item.text; },
    tables(item) {
      for (const [name, content] of Object.entries(item.tables)) table($(`#${name}`), content);
      if ("statistics" in item.tables) {
        for (const name of ["places", "paths", "lights", "compared"]) $("#" + name).hidden = !(name in item.tables);
      }
    },
    goodness(item) {
      const bar = $("#goodness progress");
      if (bar) bar.value = item.share;
    },
    colorbar(item) {
      colorbar(item.bar);
      $("#progress").textContent = item.said;
      $("#progress").hidden = !item.said;
    },
    brushed(item) { $("#brushed").textContent = item.text; },
    histogram(item) {
      draw(item);
      $("#note-image").textContent = item.notes.image.join("  |  ");
      histogram = item;
    },
    described(item) {
      $("#described").textContent = item.texts.length === 1 ? item.texts[0] : "";
      for (const [i, button] of all("[data-show]").entries()) button.title = item.texts[i];
      $("main").classList.toggle("imageonly", !item.samples);
      $("#export").hidden = !item.samples;  // there is nothing to export
    },
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
      $("#live button").textContent = item.paused ? "Draw more" : "Pause";
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
      if (item.failed && !unanswered.some((n) => n > item.seq)) fail(item.failed);
      answered(item);
      if (item.seq === pending) {
        pending = 0;
        if (following && wanted) followed(...wanted);
      }
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

  // --- light and dark ---
  let light = null;
  const tint = (color) => (document.documentElement.dataset.theme === "light" ? light[color] ?? color : color);
  function theme(name) {
    document.documentElement.dataset.theme = name;
    $("#theme").textContent = name === "light" ? "Dark" : "Light";
    const style = getComputedStyle(document.documentElement), color = (v) => style.getPropertyValue(`--${v}`).trim();
    for (const [, , , , , xaxis, yaxis, xgrid, ygrid, plot] of Object.values(models.panels)) {
      const quiet = { sync: false };
      plot.setv({ background_fill_color: color("panel"), outline_line_color: color("line") }, quiet);
      for (const grid of [xgrid, ygrid]) grid.setv({ grid_line_color: color("grid") }, quiet);
      for (const axis of [xaxis, yaxis]) axis.setv({ axis_label_text_color: color("faint"),
        major_label_text_color: color("text"), major_tick_line_color: color("faint"), axis_line_color: color("line") }, quiet);
    }
    if (drawn) fill(drawn);
    if (histogram) says.histogram(histogram);
    if (view) chips(pixelColors);
  }
  function preferred() {
    const system = matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark";
    try { return localStorage.getItem("chdstat-theme") ?? system; } catch { return system; }
  }
  function switchTheme() {
    const name = document.documentElement.dataset.theme === "light" ? "dark" : "light";
    try { localStorage.setItem("chdstat-theme", name); } catch { /* private windows keep nothing */ }
    theme(name);
  }

  function fill(item) {
    draw(item);
    // Many rows need some height each.
    const rows = Math.max(...Object.values(item.panels).map((p) => p.rows));
    $(".panels").style.setProperty("--taller", String(Math.max(1, rows / 3)));
    const batch = $("select[data-option=batch]");
    for (const o of batch.options) o.hidden = o.disabled = Number(o.value) > Math.max(1, item.most);
    batch.value = String(item.batch);
    for (const [name, notes] of Object.entries(item.notes)) $(`#note-${name}`).textContent = notes.join("  |  ");
    for (const [i, b] of all("#sources [data-show]").entries()) {
      const color = (item.legend.find(([text]) => text === item.names[i]) ?? [])[1];
      b.querySelector("i").hidden = !color;
      b.querySelector("i").style.background = color ? tint(color) : "";
    }
    $("#legend").replaceChildren(...item.legend.map(([text, color]) => {
      const s = make("span"); s.append(swatch(tint(color)), text); return s;
    }));
  }

  function draw(item) {
    const bytes = Uint8Array.from(atob(item.numbers), (c) => c.charCodeAt(0));
    const numbers = new Float64Array(bytes.buffer);
    let at = 0;
    const take = (n) => numbers.subarray(at, (at += n));
    for (const [name, panel] of Object.entries(item.panels)) {
      const [areas, lines, texts, xr, yr, xaxis, yaxis, xgrid] = models.panels[name];
      const traces = panel.lines.map((t) => ({ ...t, color: tint(t.color), x: take(t.n), y: take(t.n) }));
      const columns = (some) => ({ xs: some.map((t) => t.x), ys: some.map((t) => t.y), color: some.map((t) => t.color) });
      $(`#panel-${name}`).hidden = panel.empty;
      put(areas, columns(traces.filter((t) => t.fill)));
      const drawn = traces.filter((t) => t.width);
      put(lines, { ...columns(drawn), dash: drawn.map((t) => t.dash), width: drawn.map((t) => t.width) });
      put(texts, { ...panel.texts, color: panel.texts.color.map(tint) });
      for (const [i, [start, end]] of panel.extent.entries()) [xr, yr][i].setv({ start, end }, { sync: false });
      // An axis that changes lays the plot out anew, which takes longer than the rest.
      change(yaxis, { axis_label: panel.y, visible: !panel.rows });
      for (const part of [xaxis, xgrid]) change(part, { visible: !panel.own_x });
    }
    requestAnimationFrame(bands);  // when the axes are laid out
  }

  function change(model, values) {
    const news = Object.entries(values).filter(([name, value]) => model[name] !== value);
    if (news.length) model.setv(Object.fromEntries(news), { sync: false });
  }

  function chips(colors) {
    const chip = (shown, what, index) => {
      const drop = make("button", "×", { type: "button", "aria-label": `Drop ${what}` }), one = make("span", null, { class: "chip" });
      drop.addEventListener("click", () => send("drop", { index }));
      one.append(shown, drop);
      return one;
    };
    const found = view.pixels.map(([y, x], i) => {
      const pick = make("button", null, { type: "button", "aria-pressed": String(i === view.active) });
      pick.append(swatch(tint(colors[i])), `${i + 1}: y ${y} x ${x}`);
      pick.addEventListener("click", () => send("activate", { index: i }));
      return chip(pick, `pixel ${i + 1}`, i);
    });
    if (view.region) {
      const [t, l, b, r] = view.region;
      found.push(chip(make("span", `region y ${t}–${b - 1}, x ${l}–${r - 1} (${b - t} × ${r - l})`), "the region", 0));
    }
    if (!found.length) found.push(make("span", "Nothing is selected yet.", { class: "hint" }));
    const focused = document.activeElement && document.activeElement.closest("#chips");
    const place = focused ? all("#chips button").indexOf(document.activeElement) : -1;
    $("#chips").replaceChildren(...found);
    if (place >= 0) (all("#chips button")[place] ?? $(".image")).focus();
  }

  // A heading with a button that opens what its part of the page shows. The button is no part of its
  // name, and stays when the text changes: a screen reader says what is new.
  function heading(element, text, name) {
    if (!element.querySelector(".help")) {
      const button = make("button", "?", { type: "button", class: "help" });
      button.addEventListener("click", () => explain(name, button));
      element.replaceChildren(make("span"), " ", button);
    }
    element.firstChild.textContent = text;
    element.setAttribute("aria-label", text);
    element.querySelector(".help").setAttribute("aria-label", `Help: ${text}`);
    return element;
  }

  // A name; of a pattern, one that tells its cause and cure when it is clicked, and how it is measured.
  function named(text, measured) {
    const found = all("template[data-label]").find((t) => t.dataset.label === text);
    if (!found) return text;
    const button = make("button", text, { type: "button", class: "named", title: "Cause and cure" });
    button.addEventListener("click", () => explain(found.id.slice("help-".length), button, measured));
    return button;
  }

  function explain(name, button, measured) {
      const box = $("#help"), at = button.getBoundingClientRect();
      box.replaceChildren($(`#help-${name}`).content.cloneNode(true));
      if (measured) box.append(make("p", `Statistic: ${measured}`));
      box.style.top = `${at.bottom + 4}px`;
      box.showPopover();
      box.style.left = `${Math.max(8, Math.min(at.left, innerWidth - box.offsetWidth - 8))}px`;
      const over = box.getBoundingClientRect().bottom - innerHeight + 8;
      if (over > 0) box.style.top = `${Math.max(8, at.bottom + 4 - over)}px`;
  }

  const unfolded = new Set();
  function table(parent, content) {
    const body = make("table", null, { class: content.words ? "words" : "" });
    const head = make("tr");
    head.append(...content.columns.map((c) => make("th", c, { scope: "col" })));
    const rows = content.rows.map((cells, at) => {
      const row = make("tr");
      const measured = cells[content.columns.length] ?? "";
      row.append(...cells.slice(0, content.columns.length).map((c, i) => {
        const cell = i ? make("td", c) : make("th", null, { scope: "row" });
        if (!i) cell.append(named(c, measured));
        if (i && content.shades) [cell.style.background, cell.style.color] = content.shades[at][i - 1];
        return cell;
      }));
      row.title = measured;
      return row;
    });
    body.append(head, ...rows);
    const parts = [heading(make("h2"), content.title, parent.dataset.help ?? parent.id)];
    if (content.note) parts.push(make("p", content.note, { class: "note" }));
    const more = content.first ? rows.slice(content.first) : [];
    if (more.length) {
      const button = make("button", null, { type: "button", class: "more" });
      const fold = () => {
        for (const row of more) row.hidden = !unfolded.has(parent.id);
        button.textContent = unfolded.has(parent.id) ? "Show fewer" : `Show all ${rows.length}`;
      };
      button.addEventListener("click", () => {
        unfolded[unfolded.has(parent.id) ? "delete" : "add"](parent.id);
        fold();
      });
      fold();
      parts.push(body, button);
    } else parts.push(body);
    parent.replaceChildren(...parts);
  }

  // The test of the fits waits to be asked for, anew for each selection.
  let asked = "", offer = null, pixelColors = [];
  function untested() {
    if (!offer) {
      offer = [...$("#goodness").children];
      $("#goodness .controls button").addEventListener("click", () => {
        $("#goodness progress").hidden = false;
        $("#goodness .controls button").disabled = true;
        send("goodness");
      });
    }
    $("#goodness").replaceChildren(...offer);
    $("#goodness progress").value = 0;
    $("#goodness progress").hidden = true;
    $("#goodness .controls button").disabled = false;
  }

  // Labels and brushes have no ends that could be typed.
  const limitable = () => { $("#limits").hidden = Boolean(label?.names || view?.brush); };
  function colorbar(bar) {
    label = bar && { title: bar.title, names: bar.names, log: bar.log };
    const parent = $("#colorbar");
    parent.hidden = $("#ranging").hidden = !bar;
    if (!bar) return;
    limitable();
    for (const option of ["cmap", "signed"]) $(`[data-option=${option}]`).parentElement.hidden = bar.signed !== (option === "signed");
    if (bar.limits) all("#limits input").forEach((e, i) => { if (e !== document.activeElement) e.value = bar.limits[i]; });
    const parts = [make("span", bar.unit ? `${bar.title} (${bar.unit})` : bar.title)];
    if (bar.names) {
      const codes = make("div", null, { class: "codes" });
      codes.append(...bar.codes.map(([text, share, color]) => {
        const s = make("span"); s.append(swatch(color), named(text), ` (${share})`); return s;
      }));
      parts.push(codes);
    } else {
      const ramp = make("div", null, { class: "ramp" });
      ramp.style.background = `linear-gradient(90deg, ${bar.ramp.join(",")})`;
      const ends = make("div", null, { class: "ends" });
      for (const [share, text] of bar.ticks) {
        const tick = make("span", text);
        tick.style.left = `${100 * share}%`;
        tick.style.transform = `translateX(${-100 * Math.min(Math.max(share, 0), 1)}%)`;
        ends.append(tick);
      }
      parts.push(ramp, ends);
    }
    if (bar.note) parts.push(make("p", bar.note, { class: "note" }));
    parent.replaceChildren(...parts);
  }

  // --- ticks ---
  // No more labels than there is room for, of one size: when an axis grows or shrinks, Bokeh lays the
  // plot out anew and paints twice.
  const LABEL_WIDTH = 5;  // characters, along a vertical axis
  function tickLabel(tick, index, ticks, across, most) {
    if (index % Math.ceil(ticks.length / most)) return "";
    const largest = Math.max(...ticks.map(Math.abs));
    const steps = ticks.slice(1).map((t, i) => Math.abs(t - ticks[i])).filter((d) => d > 0);
    const digits = steps.length ? 1 + Math.ceil(Math.log10(largest / Math.min(...steps))) : 3;
    const rounded = Number(tick.toPrecision(Math.min(Math.max(digits, 1), 9)));
    const size = Math.abs(rounded), plain = size === 0 || (size >= 1e-3 && size < 1e5);
    const text = plain ? String(rounded) : rounded.toExponential().replace("+", "");
    return text.replaceAll("-", "\u2212").padStart(across ? 0 : LABEL_WIDTH, "\u00a0");
  }

  // Bokeh's own ticks of less than two decades are evenly spaced: all of them at the upper end.
  const FEW = 3, LONGEST = 6;  // labels at least; characters of one such as 0.0015, longer are 1e-4
  function logTicks(range, plot, across) {
    const low = Math.min(range.start, range.end), high = Math.max(range.start, range.end);
    if (!(low > 0 && high < Infinity)) return [];
    const span = Math.log10(high / low);
    const { inner_width: width, inner_height: height } = plot.properties;
    const room = width.is_unset ? FEW : across ? width.get_value() / 6.4 : height.get_value() / 16;
    const size = (tick) => across ? 1 + Math.min(String(tick).length, LONGEST) : 1;
    const apart = (ticks) => ticks.slice(1).every((tick, i) =>
      Math.log10(tick / ticks[i]) / span * room >= Math.max(size(tick), size(ticks[i])));
    const decades = (mantissas, every) => {
      const ticks = [];
      for (let k = Math.floor(Math.log10(low)); k <= Math.log10(high); k++)
        if (k % every === 0) ticks.push(...mantissas.map((m) => Number(`${m}e${k}`)));
      return ticks.filter((tick) => low <= tick && tick <= high);
    };
    let ticks = decades([1, 2, 5], 1);
    if (ticks.length < FEW) {
      const widest = (high - low) / FEW, unit = 10 ** Math.floor(Math.log10(widest));
      const step = unit * [5, 2, 1].find((m) => m * unit <= widest);
      ticks = [];
      for (let i = Math.ceil(low / step); i * step <= high; i++) ticks.push(i * step);
      return apart(ticks) ? ticks : ticks.filter((_, i) => i % 2 === 0);
    }
    if (!apart(ticks)) ticks = decades([1, 3], 1);
    for (const every of [1, 2, 5, 10, 20, 50, 100, 200, 500])
      if (!apart(ticks)) ticks = decades([1], every);
    return ticks;
  }

  // --- phones ---
  // Where there is little width, the image comes first, and its controls are folded below it.
  const little = matchMedia("(max-width: 600px)");
  const homes = new Map();
  function fold() {
    for (const part of all("[data-fold]")) {
      if (!homes.has(part)) {
        homes.set(part, document.createComment(""));
        part.before(homes.get(part));
      }
      if (little.matches) $(`#${part.dataset.fold}`).append(part);
      else homes.get(part).after(part);
    }
    for (const folded of all("details.fold")) folded.hidden = !little.matches;
  }
  document.addEventListener("DOMContentLoaded", fold);
  little.addEventListener("change", fold);

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
    light = JSON.parse($("#light").textContent);
    looks = JSON.parse($("#looks").textContent);
    theme(preferred());
    const asked = new URLSearchParams(location.search).get("z")?.split(",").map(Number) ?? [];
    if (asked.length === 4 && asked.every(Number.isFinite) && asked[0] < asked[2] && asked[1] < asked[3]) {
      models.x_range.setv({ start: asked[0], end: asked[2] });
      models.y_range.setv({ start: asked[3], end: asked[1] });
    }
    const opacity = new URLSearchParams(location.search).get("o");
    if (opacity !== null) {
      $("#opacity").value = opacity;  // what is no number between its ends becomes one
      fade();
    }
    for (const range of [models.x_range, models.y_range]) range.change.connect(zoomed);
    for (const [i, source] of models.radiances.entries()) source.properties.data.change.connect(() => {
      // Two frames later Bokeh has drawn it over the coarse one, which then would show beside it.
      requestAnimationFrame(() => requestAnimationFrame(() => {
        all(".image")[i].style.backgroundImage = "";
        all(".image")[i].classList.remove("waiting");
      }));
      zoomed();
    });
    $("#theme").addEventListener("click", switchTheme);
    $("#keys").addEventListener("click", () => explain("keys", $("#keys")));
    $("#follow").addEventListener("click", () => follow(!following));
    if (several()) {
      $("#side").addEventListener("click", () => side(!$("main").classList.contains("side")));
      $("#swipe").addEventListener("input", arrange);
      $("#reference").addEventListener("change", (e) => refer(Number(e.target.value)));
      for (const b of all("[data-show]")) b.addEventListener("click", (e) => (e.shiftKey ? refer : show)(Number(b.dataset.show)));
      document.addEventListener("keyup", (e) => { if (e.key === "Shift") peek(false); });
      addEventListener("blur", () => peek(false));
      if (new URLSearchParams(location.search).has("side")) side(true);
    }
    models.outbox.properties.value.change.connect(receive);
    receive();
    document.addEventListener("keydown", key);
    for (const e of all("h2[data-help]")) heading(e, e.textContent, e.dataset.help);
    for (const p of all(".image")) p.addEventListener("pointerdown", () => p.focus({ preventScroll: true }));
    for (const s of all("select[data-option]")) s.addEventListener("change", () => {
      const value = s.dataset.option === "batch" ? Number(s.value) : s.value;
      set(s.dataset.option, value);
    });
    for (const c of all("[data-family]")) c.addEventListener("change", () => {
      const value = all("[data-family]").filter((e) => e.checked).map((e) => e.dataset.family);
      set("families", value);
    });
    $("#exposure").addEventListener("input", (e) => set("exposure", Number(e.target.value)));
    $("#auto").addEventListener("click", () => set("exposure", null));
    $("#opacity").addEventListener("input", () => { fade(); zoomed(); });
    for (const name of BRUSHED) brushes(name);
    for (const e of all("#brushing input")) e.addEventListener("change", typed);
    $("#nulls").addEventListener("click", nulls);
    $("#unbrush").addEventListener("click", () => { brush(null); $("#nulls").focus(); });
    addEventListener("resize", () => requestAnimationFrame(bands));
    for (const e of all("#limits input")) e.addEventListener("change", () => {
      const value = all("#limits input").map((i) => i.valueAsNumber);
      if (value.every(Number.isFinite)) set("limits", value);
    });
    $("#limits button").addEventListener("click", () => set("limits", null));
    for (const b of all("[data-drag]")) b.addEventListener("click", () => drag(b.dataset.drag));
    for (const b of all("[data-zoom]")) b.addEventListener("click", () => zoom(b.dataset.zoom));
    for (const b of all("[data-export]")) b.addEventListener("click", () => send("export", { format: b.dataset.export }));
    $("#live button").addEventListener("click", () => send("pause"));
    $("#alert button").addEventListener("click", () => { $("#alert").hidden = true; });
    document.addEventListener("visibilitychange", () => send("visible", { on: !document.hidden }));
    // The image around it has the focus and the keys.
    for (const figure of models.figures) Bokeh.index.find_one(figure).canvas.events_el.tabIndex = -1;
    document.body.dataset.ready = "1";
    send("ready");
  }

  function lost() {
    if (!$("#alert")) return;
    says.alert({ text: "The server has stopped: start 'chdstat explore' again, and this page loads itself anew." });
    $("#working").textContent = "";
    if (unanswered.length) says.done({ seq: sent, failed: "There was no answer: the server has stopped." });
    setTimeout(again, 1000);
  }
  // The address holds the view, so that a new page shows the same.
  const again = () => fetch("/progress").then((r) => { if (r.ok) location.reload(); }).catch(() => setTimeout(again, 2000));


  document.documentElement.dataset.theme = preferred();  // before anything is painted
  return { start, tap, press, pressup, box, hover, lost, timings, tickLabel, logTicks };
})();
