// Sensor data of a vehicle; cavmarl/sensors/sensed_shapes.py defines the shapes.

import { $, element } from "./panels.js";

export class Shapes {
  constructor(told) {
    this.id = told.id;
    this.way = told.way ?? [];
    this.all = told.shapes ?? [];
    for (const shape of this.all) if (shape.rgba) shape.image = imageOf(shape);
    this.pictures = this.all.filter((shape) => shape.image || shape.kind === "numbers");
  }
}

function imageOf({ width, height, rgba }) {
  const text = atob(rgba);
  const bytes = new Uint8ClampedArray(text.length);
  for (let k = 0; k < text.length; k++) bytes[k] = text.charCodeAt(k);
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [width, height];
  canvas.getContext("2d").putImageData(new ImageData(bytes, width, height), 0, 0);
  return canvas;
}

// Shows pictures and numbers of sensors beside the map, under each sensor's name.
export function showPictures(shapes) {
  const list = $("pictures");
  const old = new Map([...list.children].map((item) => [item.dataset.name, item]));
  list.replaceChildren(...shapes.map((shape) => {
    const item = old.get(shape.name) ?? blank(shape);
    if (shape.image) {
      const shown = item.lastChild;
      [shown.width, shown.height] = [shape.width, shape.height];
      shown.getContext("2d").drawImage(shape.image, 0, 0);
    } else {
      item.lastChild.textContent = shape.rows.map(([unit, n]) => `${n} ${unit}`).join(", ");
    }
    return item;
  }));
}

function blank(shape) {
  const item = element("li");
  item.dataset.name = shape.name;
  const picture = { role: "img", "aria-label": `picture of the sensor ${shape.name}` };
  item.append(element("span", shape.name),
    shape.image ? element("canvas", undefined, picture) : element("p"));
  return item;
}
