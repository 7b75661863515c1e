// Elements in one line each.
const SVG = "http://www.w3.org/2000/svg";

export function made(name, attributes = {}, ...children) {
  return filled(document.createElement(name), attributes, children);
}

// A slider that says what it is moved to, and takes what it is told unless it is held.
export function slider(attributes, moved) {
  const one = made("input", { type: "range", step: "any", ...attributes, oninput: () => moved(Number(one.value)) });
  return Object.assign(one, { told: (value) => { if (!one.matches(":active")) one.value = value; } });
}

export function drawn(name, attributes = {}, ...children) {
  return filled(document.createElementNS(SVG, name), attributes, children);
}

function filled(element, attributes, children) {
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (value === true) element.setAttribute(key, "");
    else if (value !== false && value != null) element.setAttribute(key, value);
  }
  element.append(...children);
  return element;
}

// Where a canvas shows its picture, which is as large as its element allows.
export function boxOf(picture) {
  const box = picture.getBoundingClientRect();
  const scale = Math.min(box.width / picture.width, box.height / picture.height) || 1;
  const [width, height] = [scale * picture.width, scale * picture.height];
  return { width, height, left: box.left + (box.width - width) / 2, top: box.top + (box.height - height) / 2 };
}

export function short(value) {
  if (value == null) return "unknown";
  const size = Math.abs(value);
  return size !== 0 && (size < 1e-3 || size >= 1e5) ? value.toExponential(3) : String(Number(value.toPrecision(4)));
}
