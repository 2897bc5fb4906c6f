// Plots of the last ten minutes, one small canvas a value. In: a history. Out: the canvases and their texts.

import { duration, percent, setText } from "../text.js";
import { lines, niceTop } from "./history.js";

// [name of the row's value, title, the value in words, least value at the upper edge]
const PLOTS = [
  ["map_age_ms", "Age of the newest map", duration, 200],
  ["latency_ms_total", "Latency on the vehicle's server", duration, 100],
  ["map_rate_hz", "Maps", (hz) => `${hz.toFixed(1)} Hz`, 10],
  ["loss", "Packets lost", (share) => percent(share), 0.01],
  ["drivable_share", "Drivable ground", (share) => percent(share, 0), 1],
];

export class Plots {
  #parts = new Map();

  constructor(element) {
    for (const [name, title] of PLOTS) {
      const figure = document.createElement("figure"), caption = document.createElement("figcaption");
      const label = document.createElement("span"), value = document.createElement("b");
      const canvas = document.createElement("canvas"), axis = document.createElement("p");
      axis.append(document.createElement("span"), document.createElement("span"));
      setText(label, title);
      figure.dataset.plot = name;
      canvas.setAttribute("role", "img");
      caption.append(label, value);
      figure.append(caption, canvas, axis);
      figure.hidden = true;
      element.append(figure);
      this.#parts.set(name, { figure, value, canvas, axis });
    }
  }

  draw(history) {
    const now_ms = history.rows.at(-1)?.at_ms;
    for (const [name, title, text, least] of PLOTS) {
      const { figure, value, canvas, axis } = this.#parts.get(name);
      figure.hidden = !history.has(name);
      if (figure.hidden) continue;
      const newest = history.rows.at(-1)[name], top = niceTop(history.rows, name, least);
      setText(value, Number.isFinite(newest) ? text(newest) : "unknown");
      setText(axis.firstChild, "10 min ago");
      setText(axis.lastChild, `full height ${text(top)}`);
      canvas.setAttribute("aria-label", `${title}, the last ten minutes; now ${value.textContent}`);
      drawLines(canvas, (size) => lines(history.rows, name, now_ms, { ...size, top }));
    }
  }
}

function drawLines(canvas, linesOf) {
  const scale = devicePixelRatio, width = canvas.clientWidth, height = canvas.clientHeight;
  if (!width) return;
  if (canvas.width !== Math.round(width * scale)) canvas.width = Math.round(width * scale);
  if (canvas.height !== Math.round(height * scale)) canvas.height = Math.round(height * scale);
  const pen = canvas.getContext("2d"), style = getComputedStyle(canvas);
  pen.setTransform(scale, 0, 0, scale, 0, 0);
  pen.clearRect(0, 0, width, height);
  pen.strokeStyle = style.getPropertyValue("--line");
  pen.lineWidth = 1;
  for (const y of [0.5, height / 2, height - 0.5]) {
    pen.beginPath();
    pen.moveTo(0, y);
    pen.lineTo(width, y);
    pen.stroke();
  }
  pen.strokeStyle = pen.fillStyle = style.getPropertyValue("--good");
  pen.lineWidth = 1.5;
  pen.lineJoin = "round";
  for (const line of linesOf({ width, height: height - 2 })) {
    pen.beginPath();
    line.forEach(([x, y], i) => (i ? pen.lineTo(x, y + 1) : pen.moveTo(x, y + 1)));
    pen.stroke();
    const [x, y] = line.at(-1);
    pen.fillRect(x - 1, y, 2, 2);
  }
}
