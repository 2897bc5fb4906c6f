// As much of a browser's DOM as panel.js uses, for tests: elements with children and texts, and canvases that record
// what is drawn on them. Importing it makes the globals.

class FakeElement {
  children = [];
  style = {};
  attributes = new Map();
  hidden = false;
  title = "";
  #text = "";

  constructor(tag) {
    this.tag = tag;
    const classes = new Set();
    this.classList = {
      contains: (name) => classes.has(name),
      toggle: (name, on) => (on ? classes.add(name) : classes.delete(name)),
    };
  }

  get textContent() {
    return this.#text + this.children.map((child) => child.textContent ?? child).join("");
  }
  set textContent(text) {
    this.children = [];
    this.#text = text;
  }
  get lastChild() {
    return this.children.at(-1);
  }
  get options() {
    return this.children;
  }

  append(...nodes) {
    for (const node of nodes) if (node instanceof FakeElement) node.parent = this;
    this.children.push(...nodes);
  }
  replaceChildren(...nodes) {
    this.children = [];
    this.append(...nodes);
  }
  remove() {
    this.parent.children.splice(this.parent.children.indexOf(this), 1);
  }
  setAttribute(name, value) {
    this.attributes.set(name, value);
  }
  getAttribute(name) {
    return this.attributes.get(name) ?? null;
  }
  getBoundingClientRect() {
    return { left: 0, top: 0, width: this.clientWidth };
  }
}

// A canvas. `drawn` lists what was drawn since the last clear: [name of the call, its arguments, the pen's style].
class FakeCanvas extends FakeElement {
  drawn = [];
  getContext() {
    const { drawn } = this, pen = { measureText: () => ({ width: 0 }) };
    for (const name of ["fill", "stroke", "fillText", "strokeText"]) {
      pen[name] = (...given) => drawn.push([name, given, name.startsWith("fill") ? pen.fillStyle : pen.strokeStyle]);
    }
    pen.clearRect = () => (drawn.length = 0);
    pen.putImageData = (image) => drawn.splice(0, Infinity, ["putImageData", [image], null]);
    return pen;
  }
}

// The steps of a path: [name, arguments].
class FakePath {
  steps = [];
  constructor() {
    for (const name of ["moveTo", "lineTo", "arc", "roundRect"]) {
      this[name] = (...given) => this.steps.push([name, given]);
    }
  }
}

class FakeImage {
  constructor(width, height) {
    this.data = new Uint8ClampedArray(4 * width * height);
  }
}

const PARTS = ["title", "share", "channel", "plot", "mark", "readout", "legend", "stale"];
const CANVASES = ["cells", "paths", "overlay"];

// The template of a panel; its plot is `side` CSS pixels wide.
export function panelTemplate(side) {
  const newPanel = () => {
    const panel = new FakeElement("article"), parts = {};
    for (const name of PARTS) parts[name] = new FakeElement(name);
    for (const name of CANVASES) parts[name] = new FakeCanvas("canvas");
    parts.scale = new FakeElement("div");
    parts.scale.append(new FakeElement("i"), new FakeElement("p"));
    parts.plot.clientWidth = parts.overlay.clientWidth = side;
    panel.querySelector = (selector) => parts[/^\[data-part="(\w+)"\]$/.exec(selector)[1]];
    return panel;
  };
  return { content: { firstElementChild: { cloneNode: newPanel } } };
}

class Observer {
  constructor(notify) {
    this.notify = notify;
  }
  observe() {
    // Everything is in sight and has its size at once.
    this.notify([{ isIntersecting: true }]);
  }
}

Object.assign(globalThis, {
  devicePixelRatio: 1,
  document: { createElement: (tag) => new FakeElement(tag) },
  ImageData: FakeImage,
  IntersectionObserver: Observer,
  Option: class extends FakeElement {
    constructor(text, value) {
      super("option");
      this.textContent = text;
      this.value = value;
    }
  },
  Path2D: FakePath,
  ResizeObserver: Observer,
});
