// The outline of the cut over the picture, and grips that are pulled by the pointer or by arrows: the cut moves, the camera stays.
import { boxOf, drawn } from "./made.js";

const SIZE = 10; // pixels of the screen, half across
const STEP = 0.02; // of the picture's height, by a key
const NAMES = { share: { plane: "place of the plane", box: "size of the box", sphere: "radius of the sphere" },
  middle: { box: "middle of the box", sphere: "middle of the sphere" }, tip: { plane: "direction of the plane" } };

export function gripper(picture, { later, flush, share, pressed }) {
  const halo = drawn("path", { class: "halo" }), line = drawn("path");
  const element = drawn("svg", { class: "outline", role: "group", "aria-label": "outline of the cut" }, halo, line);
  let grips = [], held = null;

  function grip() {
    const one = drawn("circle", { class: "grip", tabindex: 0, role: "button" });
    const pull = (right, down) => later({ do: "grip", name: one.dataset.name, right, down });
    one.addEventListener("pointerdown", (event) => {
      one.setPointerCapture(event.pointerId);
      held = share(event);
    });
    one.addEventListener("pointermove", (event) => {
      if (!held) return;
      const at = share(event);
      pull(at.right - held.right, at.down - held.down);
      held = at;
    });
    for (const end of ["pointerup", "pointercancel"]) one.addEventListener(end, () => { held = null; flush(); });
    one.addEventListener("contextmenu", (event) => event.preventDefault());
    one.addEventListener("keydown", (event) => {
      const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
      if (!way) return pressed(event);
      event.preventDefault();
      event.stopPropagation();
      const size = STEP * (event.shiftKey ? 5 : 1);
      pull(size * way[0], size * way[1]);
    });
    return one;
  }
  return {
    element,
    show(outline, cut) {
      element.toggleAttribute("hidden", !outline);
      const names = outline ? outline.grips.map((one) => one.name) : [];
      const gone = grips.filter((one) => !names.includes(one.dataset.name));
      if (gone.some((one) => one.matches(":focus"))) picture.focus();
      gone.forEach((one) => one.remove());
      if (!outline) return void (grips = []);
      const wide = picture.width / picture.height;
      element.setAttribute("viewBox", `${-wide / 2} -0.5 ${wide} 1`);
      const path = outline.lines.map(([right, down, ...end]) => `M${right} ${down}L${end.join(" ")}`).join("");
      for (const one of [halo, line]) one.setAttribute("d", path);
      grips = outline.grips.map(({ name, at }) => {
        const one = grips.find((other) => other.dataset.name === name) ?? grip();
        one.dataset.name = name;
        Object.entries({ cx: at[0], cy: at[1], r: SIZE / boxOf(picture).height, "aria-label": `${NAMES[name][cut.kind]}: arrows move it` })
          .forEach(([key, value]) => one.setAttribute(key, value));
        if (!one.isConnected) element.append(one);
        return one;
      });
    },
  };
}
