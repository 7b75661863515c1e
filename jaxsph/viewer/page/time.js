// Which frame of a sequence is shown: a slider, buttons and keys; what is asked for last is read first.
import { made, short, slider } from "./made.js";

export function timer(send) {
  let frames = null;
  const handle = slider({ min: 0, max: 0, step: 1, "aria-label": "frame of the sequence" }, go);
  const value = made("output", { class: "value" });
  const button = (text, title, does) => made("button", { type: "button", title, onclick: does }, text);
  const before = button("Before", "the frame before (,)", () => step(-1)), after = button("After", "the frame after (.)", () => step(1));
  const element = made("div", {}, made("div", { class: "row" }, handle), made("div", { class: "row" }, value, before, after));

  function go(number) {
    if (!frames) return;
    const asked = Math.max(0, Math.min(frames.of - 1, number));
    if (asked === frames.asked && !frames.why) return;
    send({ do: "frame", number: asked });
    frames.asked = asked;
    handle.value = asked;
  }
  const step = (way) => go((frames?.asked ?? 0) + way);
  return {
    element,
    keys: { ",": () => step(-1), ".": () => step(1), "<": () => go(0), ">": () => go(Infinity) },
    show(told) {
      frames = told ? { ...told } : null;
      if (!told) return;
      handle.max = told.of - 1;
      handle.told(told.asked);
      const reads = told.why ? "cannot be read" : told.asked === told.number ? null : "is being read";
      const time = told.time == null ? [] : [`time ${short(told.time)}`];
      value.textContent = [`${told.asked + 1} of ${told.of}: ${told.name}`, ...(reads ? [reads] : time)].join(", ");
      handle.setAttribute("aria-valuetext", value.textContent);
      before.disabled = told.asked === 0;
      after.disabled = told.asked === told.of - 1;
    },
  };
}
