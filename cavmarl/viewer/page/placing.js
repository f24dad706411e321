// What pages put into a world: a button says what, the next click on the map, or Enter, says where.

import { $, notice } from "./panels.js";

const KINDS = ["insert", "close", "open"];

export class Placing {
  constructor(ask) {
    this.ask = ask;
    this.kind = null; // of KINDS; null: nothing is to be placed
  }

  set(kind) {
    this.kind = kind;
    for (const id of KINDS) $(id).setAttribute("aria-pressed", String(id === kind));
    $("scene").classList.toggle("placing", kind !== null);
    const how = "Click on a road, or press Enter for the one in the middle. Escape leaves it.";
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
