// The text panels of the page. Names come from maps and files, so they are only set as
// text, never as HTML.

export const $ = (id) => document.getElementById(id);

export function element(tag, text, attributes = {}) {
  const made = document.createElement(tag);
  if (text !== undefined) made.textContent = text;
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}

export function fillTable(body, rows) {
  const old = body.rows;
  rows.forEach(([name, value], k) => {
    let row = old[k];
    if (!row) {
      row = body.insertRow();
      row.append(element("th", "", { scope: "row" }), element("td"));
    }
    const isHead = value === undefined;
    row.className = isHead ? "head" : "";
    const [head, cell] = row.children;
    if (head.textContent !== String(name)) head.textContent = name;
    const text = isHead ? "" : String(value ?? "-");
    if (cell.textContent !== text) cell.textContent = text;
  });
  while (old.length > rows.length) body.deleteRow(old.length - 1);
}

const shown = (number) => (number === null ? "-" : number.toFixed(3));

export function showVehicle(told, name) {
  $("vehicle").hidden = false;
  $("vehicle-name").textContent = name;
  fillTable($("state"), told.here ? told.rows : [["state", "it has left the world"]]);
  $("note").textContent = told.note ?? "";
  $("note").hidden = !told.note;
  $("terms-box").hidden = !told.terms;
  $("observation-box").hidden = !told.observation;
  if (told.terms) fillTable($("terms"), told.terms.map(([term, value]) => [term, shown(value)]));
  if (!told.observation) return;
  const rows = [];
  let last = "";
  for (const [sensor, feature, value] of told.observation) {
    if (sensor !== last) rows.push([sensor]);
    last = sensor;
    rows.push([feature, shown(value)]);
  }
  fillTable($("observation"), rows);
}

// The nodes that run the world, with their zones and LoadScores.
export function showLoads(rows) {
  $("loads-box").hidden = !rows.length;
  const body = $("loads");
  body.replaceChildren(...rows.map(({ name, zones, score, note }) => {
    const row = element("tr");
    const shown = score === null ? note : score.toFixed(2);
    row.append(element("th", name, { scope: "row" }), element("td", zones), element("td", shown));
    return row;
  }));
}

export function showLegend(entries) {
  const list = $("legend");
  list.replaceChildren(...entries.map(([name, color]) => {
    const item = element("li");
    const sample = element("canvas", undefined, { width: 16, height: 9, "aria-hidden": "true" });
    const pen = sample.getContext("2d");
    pen.fillStyle = `rgb(${color.join(" ")})`;
    pen.fillRect(0, 0, 16, 9);
    item.append(sample, element("span", name));
    return item;
  }));
}

const WORDS = {
  collision: "collision", off_road: "off the road", wrong_way: "wrong way",
  red_light: "red light run", arrived: "arrived", transferred: "handed over",
  episode: "new episode", inserted: "vehicle added", closed: "road closed",
  opened: "road opened",
};

export function addEvents(events, stepTime, choose) {
  const list = $("events");
  for (const [tick, kind, vehicle, agent, detail] of events) {
    const which = vehicle < 0 ? "" : ` ${agent >= 0 ? `car_${agent}, ` : ""}vehicle ${vehicle}`;
    const more = detail ? ` (${detail})` : "";
    const text = `${stepTime(tick)}  ${WORDS[kind] ?? kind}${which}${more}`;
    const item = element("li");
    const button = element("button", text, { type: "button" });
    button.addEventListener("click", () => choose(tick, vehicle));
    item.append(button);
    list.prepend(item);
  }
  while (list.children.length > 200) list.lastChild.remove();
}

let lasting = "";

// Shows a message at the top; an empty one restores the permanent message.
export function notice(text, lasts = false) {
  if (lasts) lasting = text;
  $("notice").textContent = text || lasting;
  $("notice").hidden = !(text || lasting);
}

export function showScale(scale) {
  const wanted = 110 / scale;
  const power = 10 ** Math.floor(Math.log10(wanted));
  const metres = [5, 2, 1].map((k) => k * power).find((m) => m <= wanted);
  $("scale").style.width = `${Math.round(metres * scale)}px`;
  $("scale").firstElementChild.textContent = metres >= 1000 ? `${metres / 1000} km` : `${metres} m`;
}
