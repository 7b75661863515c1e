// The editor of the transfer function: control points over a histogram of what rays meet.
import { drawn, made, short } from "./made.js";

const WIDTH = 320, HEIGHT = 150, STRIP = 14, PAD = 9;
const STEP = 0.01;
let strips = 0; // of all editors of a page
const SHAPES = { // of opacity: places, and shares of the height that there is
  rising: [[0, 0], [1, 1]],
  falling: [[0, 1], [1, 0]],
  hill: [[0, 0], [0.25, 0], [0.5, 1], [0.75, 0], [1, 0]],
  shells: [[0.15, 0], [0.25, 1], [0.35, 0], [0.65, 0], [0.75, 1], [0.85, 0]],
  even: [[0, 0.5], [1, 0.5]],
};
const FINE = 16; // pieces of a line: extinction is linear, its height here is a root

export function editor(send) {
  const gradient = `jaxsph-strip-${strips++}`;
  let look = null, points = [], chosen = 0, held = null, histogram = null;
  const svg = drawn("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT + STRIP + 20}`, class: "editor", role: "group",
    "aria-label": "control points of colour and opacity" });
  const bars = drawn("g", { class: "bars" }), line = drawn("polyline", { class: "line" });
  const strip = drawn("g"), marks = drawn("g"), ticks = drawn("g", { class: "ticks" });
  const ground = drawn("rect", { x: 0, y: 0, width: WIDTH, height: HEIGHT, class: "ground" });
  svg.append(ground, bars, line, strip, ticks, marks);
  const color = made("input", { type: "color", "aria-label": "colour of the chosen point" });
  const value = made("output", { class: "value" });
  const remove = made("button", { type: "button", title: "remove the chosen point (Delete)" }, "Remove");
  const add = made("button", { type: "button", title: "add a point beside the chosen one (Enter)" }, "Add");
  const shapes = made("select", { "aria-label": "shape of opacity", onchange: () => { if (shapes.value) shape(SHAPES[shapes.value]); shapes.value = ""; } },
    made("option", { value: "" }, "Shape…"), ...Object.keys(SHAPES).map((name) => made("option", { value: name }, name)));
  const element = made("div", {}, svg, made("div", { class: "row" }, color, value, add, remove), made("div", { class: "row" }, shapes));

  const x = (place) => PAD + Math.max(0, Math.min(1, place)) * (WIDTH - 2 * PAD);
  const y = (extinction) => look.flat ? HEIGHT / 2 : HEIGHT - PAD - Math.min(1, Math.sqrt(Math.max(0, extinction) / look.top)) * (HEIGHT - 2 * PAD);
  const placeAt = (at) => Math.max(0, Math.min(1, (at - PAD) / (WIDTH - 2 * PAD)));
  const opaqueAt = (at) => look.top * Math.max(0, Math.min(1, (HEIGHT - PAD - at) / (HEIGHT - 2 * PAD))) ** 2;
  const css = (row) => `rgb(${row.slice(2, 5).map((part) => Math.round(255 * part)).join(" ")})`;
  const hex = (row) => `#${row.slice(2, 5).map((part) => Math.round(255 * part).toString(16).padStart(2, "0")).join("")}`;
  const within = (event) => {
    const box = svg.getBoundingClientRect(), scale = WIDTH / box.width;
    return [(event.clientX - box.left) * scale, (event.clientY - box.top) * scale];
  };

  function tell(done) {
    send({ do: "points", points: points.map((row) => row.slice(0, 5)), done });
    draw();
  }
  function between(place) {
    const after = points.findIndex((row) => row[0] > place);
    if (after <= 0) return [...points[after === 0 ? 0 : points.length - 1]];
    const [low, high] = [points[after - 1], points[after]];
    const part = (place - low[0]) / (high[0] - low[0]);
    return low.map((one, i) => one + part * (high[i] - one));
  }
  function shape(corners) { // colours stay where they are
    points = corners.map(([place, tall]) => [place, look.top * tall * tall, ...between(place).slice(2, 5)]);
    chosen = 0;
    tell(true);
  }
  function insert(place, extinction, done = true) {
    const row = between(place);
    row[0] = place;
    if (extinction != null && !look.flat) row[1] = extinction;
    points.push(row);
    points.sort((one, other) => one[0] - other[0]);
    chosen = points.indexOf(row);
    tell(done);
    focus();
  }
  function drop() {
    if (points.length < 2) return;
    points.splice(chosen, 1);
    chosen = Math.min(chosen, points.length - 1);
    tell(true);
    focus();
  }
  function focus() {
    marks.children[chosen]?.focus();
  }
  function move(place, extinction) {
    const low = chosen ? points[chosen - 1][0] : 0, high = chosen < points.length - 1 ? points[chosen + 1][0] : 1;
    points[chosen][0] = Math.max(low, Math.min(high, place));
    if (!look.flat) points[chosen][1] = Math.max(0, Math.min(look.top, extinction));
  }
  function draw() {
    if (!look) return;
    bars.replaceChildren();
    if (histogram) {
      for (const name of ["there", "absorbed"]) {
        histogram[name].forEach((share, i) => {
          const left = x(histogram.edges[i]), right = x(histogram.edges[i + 1]), tall = Math.sqrt(share) * (HEIGHT - 2 * PAD);
          bars.append(drawn("rect", { class: name, x: left, width: Math.max(0.5, right - left - 0.5), y: HEIGHT - PAD - tall, height: tall }));
        });
      }
    }
    line.toggleAttribute("hidden", look.flat);
    shapes.toggleAttribute("hidden", look.flat);
    svg.setAttribute("aria-label", look.flat ? "control points of colour" : "control points of colour and opacity");
    const corners = [[0, points[0][1]], ...points, [1, points[points.length - 1][1]]];
    const path = [];
    for (let i = 0; i + 1 < corners.length; i++) {
      for (let k = 0; k <= FINE; k++) {
        const part = k / FINE;
        path.push(`${x(corners[i][0] + part * (corners[i + 1][0] - corners[i][0]))},${y(corners[i][1] + part * (corners[i + 1][1] - corners[i][1]))}`);
      }
    }
    line.setAttribute("points", path.join(" "));
    strip.replaceChildren();
    if (!look.split) {
      const stops = points.map((row) => drawn("stop", { offset: `${100 * Math.max(0, Math.min(1, row[0]))}%`, "stop-color": css(row) }));
      strip.append(drawn("defs", {}, drawn("linearGradient", { id: gradient }, ...stops)));
      strip.append(drawn("rect", { x: PAD, y: HEIGHT, width: WIDTH - 2 * PAD, height: STRIP, fill: `url(#${gradient})` }));
    }
    ticks.replaceChildren(...look.ticks.filter((_, i) => i % 2 === 0).map((one, i) =>
      drawn("text", { x: [PAD, WIDTH / 2, WIDTH - PAD][i], y: HEIGHT + STRIP + 14, "text-anchor": ["start", "middle", "end"][i] }, short(one))));
    while (marks.children.length > points.length) marks.lastChild.remove();
    while (marks.children.length < points.length) marks.append(mark());
    points.forEach((row, i) => {
      const one = marks.children[i];
      one.setAttribute("cx", x(row[0]));
      one.setAttribute("cy", y(row[1]));
      one.setAttribute("fill", look.split ? "#cfd6df" : css(row));
      one.classList.toggle("chosen", i === chosen);
      one.setAttribute("aria-label", `point ${i + 1} of ${points.length}: ${look.flat ? `at ${short(row[5])}` : `extinction ${short(row[1])}`}`);
    });
    const row = points[chosen];
    color.disabled = look.split;
    if (document.activeElement !== color) color.value = hex(row);
    const at = row[5] == null || held ? [] : [`at ${short(row[5])}`];
    value.textContent = [...at, ...(look.flat ? [] : [`extinction ${short(row[1])}`])].join(", ");
    remove.disabled = points.length < 2;
  }
  const which = (element) => [...marks.children].indexOf(element);
  function mark() {
    const one = drawn("circle", { r: 6, tabindex: 0, class: "point", role: "button" });
    one.addEventListener("focus", () => { chosen = which(one); draw(); });
    one.addEventListener("pointerdown", (event) => {
      event.stopPropagation();
      chosen = which(one);
      if (event.button === 2) return drop();
      held = one;
      one.setPointerCapture(event.pointerId);
      draw();
    });
    one.addEventListener("pointermove", (event) => {
      if (held !== one) return;
      const [across, down] = within(event);
      move(placeAt(across), opaqueAt(down));
      tell(false);
    });
    const release = () => { if (held === one) { held = null; tell(true); } };
    one.addEventListener("pointerup", release);
    one.addEventListener("pointercancel", release);
    one.addEventListener("keydown", (event) => {
      const [place, opaque] = points[chosen = which(one)], tall = Math.sqrt(opaque / look.top);
      const size = event.shiftKey ? 5 * STEP : STEP;
      if (event.key === "ArrowLeft") move(place - size, opaque);
      else if (event.key === "ArrowRight") move(place + size, opaque);
      else if (event.key === "ArrowUp") move(place, look.top * (tall + size) ** 2);
      else if (event.key === "ArrowDown") move(place, look.top * Math.max(0, tall - size) ** 2);
      else if (event.key === "Delete" || event.key === "Backspace") { event.preventDefault(); event.stopPropagation(); return drop(); }
      else if (event.key === "Enter") { event.preventDefault(); event.stopPropagation(); return beside(); }
      else return;
      event.preventDefault();
      event.stopPropagation();
      tell(true);
    });
    return one;
  }
  function beside() {
    const next = points[chosen + 1] ?? points[chosen - 1] ?? [1];
    insert((points[chosen][0] + next[0]) / 2);
  }
  svg.addEventListener("contextmenu", (event) => event.preventDefault());
  ground.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    const [across, down] = within(event);
    insert(placeAt(across), opaqueAt(down), false);
    held = marks.children[chosen]; // and dragged on, if one likes
    held.setPointerCapture(event.pointerId);
  });
  ground.addEventListener("mousedown", (event) => event.preventDefault()); // which would take the focus away again
  color.addEventListener("input", () => {
    const parts = [1, 3, 5].map((i) => parseInt(color.value.slice(i, i + 2), 16) / 255);
    points[chosen].splice(2, 3, ...parts);
    tell(false);
  });
  color.addEventListener("change", () => tell(true));
  add.addEventListener("click", beside);
  remove.addEventListener("click", drop);

  return {
    element,
    show(told) {
      element.hidden = !told;
      if (!told || held) return;
      look = told;
      points = told.points.map((row) => [...row]);
      chosen = Math.min(chosen, points.length - 1);
      draw();
    },
    over(told) { histogram = told; draw(); },
  };
}
