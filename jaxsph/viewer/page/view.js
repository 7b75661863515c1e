// A view: the picture with what it is in words, and beside it all that changes it.
import { cutter } from "./cut.js";
import { editor } from "./editor.js";
import { boxOf, drawn, made, short, slider } from "./made.js";
import { KEYS, moves } from "./moves.js";
import { timer } from "./time.js";

const MAPS = ["viridis", "heat", "ice", "coolwarm", "gray", "magma", "inferno", "plasma", "cividis", "turbo",
  "cmocean:thermal", "crameri:batlow"];
const NICE = [1, 2, 5];
const LONG = 700; // milliseconds after which a picture that is not there waits for a compiler, or a slow machine

export function mount(root, link) {
  root.classList.add("jaxsph");
  let state = null, shown = null, drawing = 0, late = 0;
  const send = (message) => link.send(message);

  const picture = made("canvas", { class: "picture", tabindex: 0, role: "img", "aria-label": "rendered view", width: 4, height: 3 });
  const bar = made("div", { class: "bar" }), rule = made("i"), length = made("span");
  bar.append(rule, length);
  const triad = drawn("svg", { class: "triad", viewBox: "-30 -30 60 60", "aria-hidden": "true" });
  const chip = made("b", { class: "chip" }, "…"), words = made("span", { class: "words" }, "compiling what is rendered: once");
  const status = made("div", { class: "status", role: "status", "aria-live": "polite" }, chip, words);
  const told = made("div", { class: "told", role: "alert", hidden: true });
  const frame = made("div", { class: "frame" }, picture, bar, triad);
  const stage = made("main", { class: "stage" }, frame, told, status);

  const button = (text, title, does, more = {}) => made("button", { type: "button", title, onclick: does, ...more }, text);
  const axis = (name) => button(name, `along ${name} (shift: from the other side)`, (event) => send({ do: "axis", name: event.shiftKey ? `-${name}` : name }));
  const rays = button("Perspective", "perspective or parallel rays (p)", () => turnRays());
  const camera = section("Camera",
    made("div", { class: "row" }, axis("x"), axis("y"), axis("z"), button("Oblique", "oblique (0)", () => send({ do: "axis", name: "iso" }))),
    made("div", { class: "row" }, button("Fit", "fit all (f)", () => send({ do: "fit" })), button("Home", "the first view (h)", () => send({ do: "home" })), rays));
  const edit = editor(send), cut = cutter(send);
  const cuts = section("Cut", cut.element);
  const time = timer(send), times = section("Time", time.element);
  times.hidden = true;
  const maps = made("select", { "aria-label": "colour map", onchange: () => { if (maps.value) send({ do: "colormap", name: maps.value }); maps.value = ""; } },
    made("option", { value: "" }, "Colour map…"), ...MAPS.map((name) => made("option", { value: name }, name)));
  const opaque = [button("Thinner", "half as opaque", () => send({ do: "exposure", stops: -1 })), button("Denser", "twice as opaque", () => send({ do: "exposure", stops: 1 }))];
  const look = section("Colour and opacity", edit.element,
    made("div", { class: "row" }, maps, ...opaque),
    made("div", { class: "row" }, button("Undo", "undo (u)", () => send({ do: "undo" })), button("Redo", "redo (y)", () => send({ do: "redo" })), button("Reset", "as it was", () => send({ do: "reset_look" }))));
  const shapes = Object.fromEntries(["level", "smoothing"].map((name) => [name, [made("output", { class: "value" }),
    slider({ min: -2, max: 1, "aria-label": name }, (power) => send({ do: "surface", [name]: state.surface[name][0] * 2 ** power }))]]));
  const shape = section("Surface", ...Object.values(shapes).map(([value, moved]) => made("div", { class: "row" }, moved, value)));
  const numbers = made("dl", { class: "numbers" }, made("dt", {}, "click the picture"), made("dd", {}, "for its numbers"));
  const pixel = section("Pixel", numbers);
  const code = made("pre", { class: "code", tabindex: 0 }), copied = made("output", { class: "value" });
  const texts = made("dialog", { class: "dialog", "aria-label": "code" }, made("h2", {}, "This view, again"), code,
    made("div", { class: "row" }, closing(), button("Copy", "copy to the clipboard", copy), copied));
  const help = made("dialog", { class: "dialog", "aria-label": "help" }, made("h2", {}, "Help"),
    made("table", {}, ...KEYS.map(([keys, does]) => made("tr", {}, made("th", { scope: "row" }, keys), made("td", {}, does)))),
    made("p", {}, "A draft has a fraction of the pixels and samples. Once nothing moves, every pixel gets its ray, then the tolerance is kept. The words below the picture say which of these you see, and how far it may be off. Bars behind the control points: what rays of the last view that stood still met (pale), and what took their light (bright); heights are roots. A surface is opaque: its bars are where rays met it, and its points have colours alone."), closing());
  const files = link.files ? [made("a", { class: "button", href: "view.exr", download: "view.exr" }, "EXR"), made("a", { class: "button", href: "look.json", download: "look.json" }, "Look")] : [];
  const keep = section("Keep", made("div", { class: "row" }, button("PNG", "save the picture (s)", save), ...files, button("Code", "Python", () => send({ do: "code" })), button("Help", "help (?)", () => help.showModal())));
  const path = made("a", { class: "button", href: "keys.json", download: "keys.json", title: "for jaxsph movie --camera", hidden: true }, "Keys");
  const kept = made("output", { class: "value" }), paths = section("Movie", made("div", { class: "row" },
    button("Keep view", "keep this view as a key frame (g)", () => send({ do: "key" })), button("Forget", "forget the last key frame (b)", () => send({ do: "unkey" })), path), kept);
  paths.hidden = !link.files;
  root.append(made("div", { class: "whole" }, stage, made("aside", { class: "panel", "aria-label": "what is shown" }, made("h1", {}, "jaxsph"), camera, times, look, shape, cuts, pixel, paths, keep)), texts, help);

  function section(title, ...children) {
    return made("section", {}, made("h2", {}, title), ...children);
  }
  function closing() {
    return made("form", { method: "dialog" }, made("button", {}, "Close"));
  }
  function turnRays() {
    if (state) send({ do: "projection", name: state.pose.perspective ? "parallel" : "perspective" });
  }
  async function copy() {
    const chosen = getSelection();
    chosen.selectAllChildren(code);
    try {
      await navigator.clipboard.writeText(code.textContent);
      copied.textContent = "copied";
    } catch { // where a page may not write there
      copied.textContent = document.execCommand("copy") ? "copied" : "press Ctrl+C: it is selected";
    }
  }
  function save() {
    const to = made("a", { download: "view.png" });
    if (link.files) {
      to.href = "view.png";
      to.click();
      return;
    }
    picture.toBlob((blob) => {
      to.href = URL.createObjectURL(blob);
      to.click();
      URL.revokeObjectURL(to.href);
    });
  }
  moves(picture, send, { ...cut.keys, ...time.keys, p: turnRays, s: save, g: () => send({ do: "key" }), b: () => send({ do: "unkey" }), "?": () => help.showModal() });

  // In the middle of the canvas: where it has got another size, what a former picture shows is where it will be.
  function paint(what, width, height, tangent) {
    const down = picture.height * (tangent / (state?.pose.tangent ?? tangent)), across = (down * width) / height;
    const brush = picture.getContext("2d");
    Object.assign(brush, { imageSmoothingEnabled: true, imageSmoothingQuality: "high" });
    brush.clearRect(0, 0, picture.width, picture.height);
    brush.drawImage(what, (picture.width - across) / 2, (picture.height - down) / 2, across, down);
  }
  function resize([width, height], tangent) {
    if (picture.width === width && picture.height === height) return;
    const former = made("canvas", { width: picture.width, height: picture.height });
    former.getContext("2d").drawImage(picture, 0, 0);
    Object.assign(picture, { width, height });
    paint(former, former.width, former.height, tangent);
  }
  async function show(header, blob) {
    const turn = ++drawing;
    const bitmap = await createImageBitmap(blob);
    if (turn < (shown?.turn ?? 0)) return bitmap.close();
    shown = { ...header, turn };
    paint(bitmap, ...header.size, header.tangent);
    bitmap.close();
    clearTimeout(late);
    late = 0;
    root.dataset.stage = header.stage;
    root.dataset.version = header.version;
    const old = Boolean(state) && header.version < state.version; // than the view that is asked for
    root.dataset.final = header.final && !old;
    if (old) awaited();
    if (old && header.stage !== "draft") return;
    const kind = header.stage === "tolerance" && header.over ? "over" : header.stage;
    chip.textContent = header.stage;
    chip.className = `chip ${kind}`;
    words.textContent = `${header.words.replace(/^(draft|full): /, "")} · ${header.milliseconds} ms`;
  }
  function awaited() { // until the picture is that of the view, nothing says that it is
    root.dataset.final = false;
    if (root.dataset.stage !== "draft") {
      chip.textContent = "drawing";
      chip.className = "chip";
    }
    late ||= setTimeout(() => {
      chip.textContent = "compiling";
      chip.className = "chip";
      words.textContent = "this view is not drawn yet: what is new in it is compiled, once";
    }, LONG);
  }
  function place() {
    if (!state) return;
    const box = boxOf(picture);
    const unit = state.height / box.height, most = (box.width / 5) * unit;
    const power = 10 ** Math.floor(Math.log10(most));
    const nice = power * NICE.filter((one) => one * power <= most).pop();
    rule.style.width = `${nice / unit}px`;
    length.textContent = `${short(nice)}${state.pose.perspective ? " at the middle" : ""}`;
    const ends = ["x", "y", "z"].map((name, i) => ({ name, right: state.axes[0][i], up: state.axes[1][i], away: state.axes[2][i] }));
    triad.replaceChildren(...ends.sort((one, other) => other.away - one.away).map(({ name, right, up }) =>
      drawn("g", { class: name }, drawn("line", { x1: 0, y1: 0, x2: 20 * right, y2: -20 * up }), drawn("text", { x: 26 * right, y: -26 * up + 3.5 }, name))));
    rays.textContent = state.pose.perspective ? "Perspective" : "Parallel";
  }
  function pick(found) {
    const rows = [];
    const row = (name, text) => rows.push(made("dt", {}, name), made("dd", {}, text));
    if (found.text) row("pixel", found.text);
    else {
      row("pixel", `row ${found.row}, column ${found.column} of ${found.of[0]} × ${found.of[1]} (${found.stage})`);
      row("colour", found.color.map((part) => part.toFixed(3)).join(", "));
      row("alpha", (1 - found.transmittance).toFixed(4));
      if (found.error != null) row("error", `at most ${short(found.error)}`);
      if (found.place) {
        row(found.normal ? "depth of the surface" : "depth at half light", short(found.depth));
        row("place", found.place.map(short).join(", "));
        if (found.normal) row("normal", found.normal.map((part) => part.toFixed(3)).join(", "));
        if (found.neighbours != null) row("quantity", `${short(found.quantity)}, of ${found.neighbours} particles`);
      } else row("depth", found.surface ? "no surface there" : "less than half of the light is absorbed");
    }
    numbers.replaceChildren(...rows);
    numbers.classList.remove("stale");
  }
  function complain(text) {
    told.textContent = text;
    told.hidden = !text;
  }
  link.on((message, blob) => {
    if (message.is === "picture") show(message, blob);
    else if (message.is === "state") {
      if (numbers.children.length > 2 && state?.version !== message.version) numbers.classList.add("stale");
      const { tangent } = (state ?? message).pose;
      state = message;
      resize(state.size, tangent);
      if (shown && shown.version < state.version) awaited();
      complain(message.told || message.frames?.why);
      edit.show(message.look);
      cut.show(message.cut);
      kept.textContent = `${message.keys} key frame${message.keys === 1 ? "" : "s"}, 2 s apart`;
      path.hidden = message.keys < 2;
      times.hidden = !message.frames;
      time.show(message.frames);
      shape.hidden = !message.surface;
      for (const [name, [given, now]] of Object.entries(message.surface ?? {})) {
        shapes[name][1].told(Math.log2(now / given));
        shapes[name][0].textContent = `${name} ${short(now)}`;
      }
      look.hidden = !message.look;
      look.firstChild.textContent = message.look?.flat ? "Colour" : "Colour and opacity"; // a surface is opaque
      opaque.forEach((one) => { one.hidden = Boolean(message.look?.flat); });
      place();
    } else if (message.is === "histogram") edit.over(message);
    else if (message.is === "picked") pick(message);
    else if (message.is === "error") {
      clearTimeout(late);
      complain(message.text);
    }
    else if (message.is === "code") {
      code.textContent = message.python;
      copied.textContent = "";
      texts.showModal();
    } else if (message.is === "unlinked") {
      chip.textContent = "lost";
      chip.className = "chip over";
      words.textContent = "jaxsph view has ended, or cannot be reached; trying again";
    } else if (message.is === "linked") complain("");
  });
  new ResizeObserver(place).observe(picture);
}
