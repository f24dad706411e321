// Insertions: a button chooses the kind; the next click on the map, or Enter, chooses the place.

import { $, notice } from "./panels.js";

const KINDS = ["insert", "close", "open"];

export class Placing {
  constructor(ask) {
    this.ask = ask;
    this.kind = null; // one of KINDS; null: no insertion is pending
  }

  set(kind) {
    this.kind = kind;
    for (const id of KINDS) $(id).setAttribute("aria-pressed", String(id === kind));
    $("scene").classList.toggle("placing", kind !== null);
    const how = "Click on a road, or press Enter for the road in the middle. Escape cancels.";
    notice(kind ? how : "");
    if (kind) $("scene").focus();
  }

  at(x, y) {
    this.ask({ kind: this.kind, x, y });
    this.set(null);
  }

  wire() {
    for (const id of KINDS) {
      $(id).addEventListener("click", () => this.set(this.kind === id ? null : id));
    }
  }

  show(may) {
    for (const id of KINDS) $(id).hidden = !may(id);
    if (this.kind) this.set(null);
  }
}
