// All worlds of a server side by side, each in its own small page.

import { $, element } from "./panels.js";

// Whether this page is one of these small pages.
export const small = parent !== window && Boolean(parent.viewer);

let shown = false;

export function toggleAll(worlds) {
  shown = !shown;
  $("all").setAttribute("aria-pressed", String(shown));
  $("worlds").hidden = !shown;
  $("worlds").style.setProperty("--columns", String(Math.ceil(Math.sqrt(worlds.length))));
  $("worlds").replaceChildren(...(shown ? worlds : []).map((name, k) =>
    element("iframe", undefined, { src: `/?small#world=${k}`, title: name })));
}
