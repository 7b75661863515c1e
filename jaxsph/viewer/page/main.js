// The page: a socket to the server of this machine, and the view.
import { mount } from "./view.js";

const RETRY = 1000; // milliseconds
const KEEP = 400;
const STILL = 250;

function link() {
  const heard = [];
  let socket = null;
  const waiting = [];
  const tell = (message, picture) => heard.forEach((one) => one(message, picture));
  function open() {
    const at = new URL("socket", document.baseURI);
    at.protocol = "ws:";
    socket = new WebSocket(at);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      tell({ is: "linked" });
      waiting.splice(0).forEach((text) => socket.send(text));
    };
    socket.onmessage = ({ data }) => {
      if (typeof data === "string") return tell(JSON.parse(data));
      const length = new DataView(data).getUint32(0);
      const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
      tell(header, new Blob([new Uint8Array(data, 4 + length)], { type: `image/${header.format}` }));
    };
    socket.onclose = () => {
      tell({ is: "unlinked" });
      setTimeout(open, RETRY);
    };
  }
  return {
    files: true,
    open,
    on: (one) => heard.push(one),
    send: (message) => {
      const text = JSON.stringify(message);
      if (socket && socket.readyState === WebSocket.OPEN) socket.send(text);
      else if (waiting.length < 100) waiting.push(text);
    },
  };
}

// The address holds the view: what is behind # is restored, and follows what is seen.
function kept(one) {
  let timer = 0;
  if (location.hash.length > 1) {
    try {
      const { pose, points, cut, frame } = JSON.parse(decodeURIComponent(location.hash.slice(1)));
      if (frame != null) one.send({ do: "frame", number: frame });
      one.send({ do: "restore", pose, points, cut });
    } catch {
      history.replaceState(null, "", location.pathname + location.search);
    }
  }
  one.on((message) => {
    if (message.is !== "state") return;
    clearTimeout(timer);
    timer = setTimeout(() => {
      const view = { pose: message.pose, cut: message.cut, frame: message.frames?.asked };
      if (message.edited) view.points = message.look.points.map((row) => row.slice(0, 5));
      const hash = message.moved || message.edited || message.cut || message.frames?.asked ? `#${encodeURIComponent(JSON.stringify(view))}` : "";
      history.replaceState(null, "", location.pathname + location.search + hash);
    }, KEEP);
  });
}

// A view fits the window, in the pixels of its screen: at once, then whenever the window has come to rest. Words that come and go
// below the picture are no reason.
function fitted(one) {
  let timer = 0;
  const fit = () => {
    const { width, height } = document.querySelector(".frame").getBoundingClientRect();
    const [across, down] = [width, height].map((side) => Math.round(devicePixelRatio * side));
    if (across && down) one.send({ do: "size", width: across, height: down });
  };
  const soon = () => {
    clearTimeout(timer);
    timer = setTimeout(fit, STILL);
  };
  fit();
  new ResizeObserver(soon).observe(document.body);
  addEventListener("resize", soon); // also where its pixels alone become others
}

const one = link();
mount(document.body, one);
fitted(one);
kept(one); // in the window's own shape
one.open();
