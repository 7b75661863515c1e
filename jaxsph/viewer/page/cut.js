// What is cut away: a plane that follows the view, a box, a sphere; moved or sized by a slider or keys.
import { made, short, slider } from "./made.js";

const KINDS = ["off", "plane", "box", "sphere"];
const STEP = 0.02; // of the reach, by a key
const NAMES = { plane: "behind the middle", box: "half a side", sphere: "radius" };

export function cutter(send) {
  let cut = null;
  const button = (text, title, does) => made("button", { type: "button", title, onclick: does, "aria-pressed": "false" }, text);
  const kinds = KINDS.map((kind) => button(kind[0].toUpperCase() + kind.slice(1), kind === "off" ? "show all (x: the next)" : `show what is in a ${kind} (x: the next)`, () => choose(kind)));
  kinds[1].title = "cut away what is before a plane (x: the next)";
  const handle = slider({ min: 0, max: 1, "aria-label": "place or size of the cut" }, move);
  const value = made("output", { class: "value" });
  const other = button("Other side", "show what is on the other side (o)", () => turn("outside"));
  const follow = button("Follow", "the plane turns with the view (k)", () => turn("follows"));
  const here = button("Here", "measure from what the view turns about now", () => send({ do: "cut", here: true }));
  here.removeAttribute("aria-pressed");
  const more = [made("div", { class: "row" }, handle, value), made("div", { class: "row" }, other, follow, here)];
  const element = made("div", {}, made("div", { class: "row" }, ...kinds), ...more);

  function choose(kind) {
    send({ do: "cut", kind });
  }
  function turn(name) {
    if (cut) send({ do: "cut", [name]: !cut[name] });
  }
  function move(to) {
    if (!cut) return;
    cut.share = Math.max(cut.least, Math.min(cut.most, to));
    send({ do: "cut", share: cut.share });
    draw();
  }
  function draw() {
    kinds.forEach((one, i) => one.setAttribute("aria-pressed", String(KINDS[i] === (cut?.kind ?? "off"))));
    more.forEach((one) => { one.hidden = !cut; });
    if (!cut) return;
    Object.assign(handle, { min: cut.least, max: cut.most });
    handle.told(cut.share);
    value.textContent = `${NAMES[cut.kind]}: ${short(cut.share * cut.reach)}`;
    handle.setAttribute("aria-valuetext", value.textContent);
    other.setAttribute("aria-pressed", String(cut.outside));
    follow.setAttribute("aria-pressed", String(cut.follows));
    follow.hidden = cut.kind !== "plane";
  }
  handle.addEventListener("keydown", (event) => { // which step "any" leaves to the browser
    const way = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[event.key];
    if (!way) return;
    event.preventDefault();
    step(way, event.shiftKey);
  });
  function step(way, far) {
    if (cut) move(cut.share + way * STEP * (far ? 5 : 1));
  }
  draw();
  return {
    element,
    keys: {
      x: () => choose(KINDS[(KINDS.indexOf(cut?.kind ?? "off") + 1) % KINDS.length]),
      n: () => step(-1), m: () => step(1), N: () => step(-1, true), M: () => step(1, true),
      o: () => turn("outside"), k: () => turn("follows"),
    },
    show(told) {
      cut = told ? { ...told } : null;
      draw();
    },
  };
}
