// Which frame of a sequence is shown: a slider, buttons and keys; what is asked for last is read first.
import { made, short } from "./made.js";

export function timer(send) {
  let frames = null, held = false;
  const slider = made("input", { type: "range", min: 0, max: 0, step: 1, "aria-label": "frame of the sequence" });
  const value = made("output", { class: "value" });
  const button = (text, title, does) => made("button", { type: "button", title, onclick: does }, text);
  const before = button("Before", "the frame before (,)", () => step(-1)), after = button("After", "the frame after (.)", () => step(1));
  const element = made("div", {}, made("div", { class: "row" }, slider), made("div", { class: "row" }, value, before, after));

  function go(number) {
    if (!frames) return;
    const asked = Math.max(0, Math.min(frames.of - 1, number));
    if (asked === frames.asked && !frames.why) return;
    send({ do: "frame", number: asked });
    frames.asked = asked;
    slider.value = asked;
  }
  const step = (way) => go((frames?.asked ?? 0) + way);
  slider.addEventListener("pointerdown", () => { held = true; });
  slider.addEventListener("input", () => go(Number(slider.value)));
  for (const end of ["pointerup", "pointercancel", "change"]) slider.addEventListener(end, () => { held = false; });
  return {
    element,
    keys: { ",": () => step(-1), ".": () => step(1), "<": () => go(0), ">": () => go(Infinity) },
    show(told) {
      frames = told ? { ...told } : null;
      if (!told) return;
      slider.max = told.of - 1;
      if (!held) slider.value = told.asked;
      const reads = told.why ? "cannot be read" : told.asked === told.number ? null : "is being read";
      const time = told.time == null ? [] : [`time ${short(told.time)}`];
      value.textContent = [`${told.asked + 1} of ${told.of}: ${told.name}`, ...(reads ? [reads] : time)].join(", ");
      slider.setAttribute("aria-valuetext", value.textContent);
      before.disabled = told.asked === 0;
      after.disabled = told.asked === told.of - 1;
    },
  };
}
