// A notebook: messages of the kernel, and the view.
import { mount } from "./view.js";

export function render({ model, el }) {
  const heard = [];
  const receive = (message, buffers) => {
    const picture = message.is === "picture" ? new Blob([buffers[0]], { type: `image/${message.format}` }) : undefined;
    heard.forEach((one) => one(message, picture));
    if (picture) model.send({ do: "seen" });
  };
  model.on("msg:custom", receive);
  el.classList.add("inside");
  el.addEventListener("keydown", (event) => { // a notebook takes letters for commands, such as to delete a cell
    if (!event.ctrlKey && !event.metaKey && !event.altKey) event.stopPropagation();
  });
  mount(el, { files: false, on: (one) => heard.push(one), send: (message) => model.send(message) });
  model.send({ do: "hello" });
  return () => model.off("msg:custom", receive);
}
