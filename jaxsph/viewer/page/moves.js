// Pointer and keys on the picture: what is dragged is sent once a frame of the screen.
import { boxOf } from "./made.js";

const CLICK = 4; // pixels that a click may move
const STEP = 0.03; // of the picture's height, by a key
const WHEEL = 0.0015;

export const KEYS = [
  ["drag, arrows", "turn"],
  ["shift-drag, right drag, shift-arrows", "move across"],
  ["wheel, + and −", "nearer, farther"],
  ["[ and ]", "roll"],
  ["1, 2, 3", "along x, y, z; with shift from the other side"],
  ["0", "oblique"],
  ["f, h", "fit all, back to the first view"],
  ["p", "perspective or parallel rays"],
  ["double click, c", "what is seen there (in the middle) becomes the middle"],
  ["click, i", "numbers of a pixel (of the middle)"],
  ["x", "cut: by a plane, a box, a sphere, not at all"],
  ["n, m", "move or size the cut, with shift by more"],
  ["o, k", "the other side of the cut; whether its plane follows the view"],
  [", and .", "the frame before, and after, of a sequence; with shift the first, and the last"],
  ["u, y", "undo, redo a change of colours and opacity"],
  ["g, b", "keep this view as a key frame of a movie, forget the last one"],
  ["s", "save the picture"],
  ["?", "this help"],
  ["Tab", "to control points: arrows move one, Delete removes it, Enter adds one beside it"],
];

export function moves(picture, send, doing) {
  let held = null, waiting = null, due = 0;
  const share = (event) => {
    const box = boxOf(picture);
    return {
      right: (event.clientX - box.left - box.width / 2) / box.height,
      down: (event.clientY - box.top - box.height / 2) / box.height,
    };
  };
  function later(message) {
    if (waiting && waiting.do !== message.do) flush();
    if (!waiting) waiting = { ...message };
    else if (message.do === "zoom") waiting.factor *= message.factor;
    else {
      waiting.right += message.right;
      waiting.down += message.down;
    }
    if (!due) due = requestAnimationFrame(flush);
  }
  function flush() {
    cancelAnimationFrame(due);
    due = 0;
    if (waiting) send(waiting);
    waiting = null;
  }
  picture.addEventListener("pointerdown", (event) => {
    picture.setPointerCapture(event.pointerId);
    const does = event.button === 0 && !event.shiftKey ? "orbit" : "pan";
    held = { does, at: share(event), x: event.clientX, y: event.clientY, far: false, button: event.button };
  });
  picture.addEventListener("pointermove", (event) => {
    if (!held) return;
    held.far ||= Math.hypot(event.clientX - held.x, event.clientY - held.y) > CLICK;
    if (!held.far) return;
    const at = share(event);
    later({ do: held.does, right: at.right - held.at.right, down: at.down - held.at.down });
    held.at = at;
  });
  const release = (event) => {
    flush();
    if (held && !held.far && held.button === 0 && event.type === "pointerup") send({ do: "pick", ...share(event) });
    held = null;
  };
  picture.addEventListener("pointerup", release);
  picture.addEventListener("pointercancel", release);
  picture.addEventListener("contextmenu", (event) => event.preventDefault());
  picture.addEventListener("dblclick", (event) => send({ do: "center", ...share(event) }));
  picture.addEventListener("wheel", (event) => {
    event.preventDefault();
    const away = Math.max(-400, Math.min(400, event.deltaY * (event.deltaMode === 1 ? 16 : 1))); // lines or pixels
    later({ do: "zoom", factor: Math.exp(-away * WHEEL), ...share(event) });
  }, { passive: false });
  picture.addEventListener("keydown", (event) => {
    if (event.altKey || ((event.ctrlKey || event.metaKey) && event.key !== "z")) return;
    if (!byKey(event)) return;
    event.preventDefault();
    event.stopPropagation(); // notebooks have keys of their own
  });
  function byKey(event) {
    const { key, shiftKey } = event;
    const arrow = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[key];
    const axis = { Digit1: "x", Digit2: "y", Digit3: "z" }[event.code];
    const middle = { right: 0, down: 0 };
    if (arrow) later({ do: shiftKey ? "pan" : "orbit", right: STEP * arrow[0], down: STEP * arrow[1] });
    else if (key === "+" || key === "=") later({ do: "zoom", factor: 1.15, ...middle });
    else if (key === "-") later({ do: "zoom", factor: 1 / 1.15, ...middle });
    else if (key === "[" || key === "]") send({ do: "roll", degrees: key === "[" ? 5 : -5 });
    else if (axis) send({ do: "axis", name: shiftKey ? `-${axis}` : axis });
    else if (key === "0") send({ do: "axis", name: "iso" });
    else if (key === "f") send({ do: "fit" });
    else if (key === "h") send({ do: "home" });
    else if (key === "c") send({ do: "center", ...middle });
    else if (key === "i") send({ do: "pick", ...middle });
    else if (key === "u" || (key === "z" && (event.ctrlKey || event.metaKey))) send({ do: "undo" });
    else if (key === "y") send({ do: "redo" });
    else if (doing[key]) doing[key]();
    else return false;
    return true;
  }
}
