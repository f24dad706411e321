// Colours of the map by theme, and of vehicles by the chosen property.

const rgb = (...bytes) => bytes.map((c) => c / 255);

// Surface colours in the order of map_geometry.py: road, path, kerb, mark, centre line, building.
export const THEMES = {
  light: {
    land: rgb(235, 237, 230),
    surfaces: new Float32Array([
      ...rgb(98, 107, 119), ...rgb(212, 211, 203), ...rgb(205, 208, 200),
      ...rgb(214, 219, 224), ...rgb(226, 206, 150), ...rgb(218, 211, 200),
    ]),
    ink: "#2c343e",
    halo: "rgb(252 252 250 / 85%)",
  },
  dark: {
    land: rgb(20, 24, 29),
    surfaces: new Float32Array([
      ...rgb(58, 65, 75), ...rgb(44, 47, 51), ...rgb(36, 41, 47),
      ...rgb(140, 148, 157), ...rgb(150, 134, 88), ...rgb(33, 36, 42),
    ]),
    ink: "#e6e9ec",
    halo: "rgb(20 24 29 / 80%)",
  },
};

export const AGENTS = [
  [255, 127, 14], [30, 144, 255], [236, 64, 122], [46, 184, 92], [255, 202, 40],
  [149, 97, 226], [0, 188, 212], [244, 81, 60], [156, 204, 40], [205, 92, 190],
];
const TRAFFIC = [186, 204, 225];
const SCRIPTED = [250, 232, 120];
export const SELECTION = [255, 80, 200];

// By vehicle class: passenger, truck, bus, motorcycle, emergency, delivery, taxi, tram, bicycle,
// pedestrian.
const CLASSES = [
  [186, 204, 225], [190, 120, 60], [214, 69, 65], [140, 90, 200], [240, 60, 60],
  [220, 160, 90], [245, 205, 50], [60, 150, 140], [110, 190, 80], [240, 150, 190],
];

const packed = ([r, g, b]) => ((255 << 24) | (b << 16) | (g << 8) | r) >>> 0;
const packAll = (inks) => Uint32Array.from(inks, packed);

// Returns a function of a row that gives its colour as 0xAABBGGRR; `zones`: their colours.
export function inks(coloring, zones) {
  const classes = packAll(CLASSES);
  const owners = packAll(zones);
  const agents = packAll(AGENTS);
  const [traffic, scripted] = packAll([TRAFFIC, SCRIPTED]);
  if (coloring === "type") return (roster, k) => classes[roster.classes[k] % classes.length];
  if (coloring === "zone") {
    return (roster, k) => owners[Math.max(roster.zones[k], 0) % owners.length];
  }
  return (roster, k) => {
    if (roster.agents[k] >= 0) return agents[roster.agents[k] % agents.length];
    return roster.drivers[k] === 2 ? scripted : traffic;
  };
}

// Names and colours of the legend.
export function legend(coloring, hello, map, roster) {
  if (coloring === "type") {
    const there = [...new Set(roster.classes)].sort((a, b) => a - b);
    return there.map((k) => [hello.classes[k] ?? String(k), CLASSES[k % CLASSES.length]]);
  }
  if (coloring === "zone") {
    const count = Math.max(hello.zones.length, 1);
    const colors = map.zone_colors;
    return Array.from({ length: Math.min(count, 8) }, (_, k) =>
      [`zone ${k}`, colors[k % colors.length]]);
  }
  if (coloring === "speed") {
    return [["0", [214, 46, 38]], ["45", [247, 199, 64]], ["90 km/h", [31, 158, 120]]];
  }
  const found = [["traffic", TRAFFIC]];
  if (roster.drivers.includes(2)) found.push(["script", SCRIPTED]);
  hello.agents.slice(0, 6).forEach((name, k) => found.push([name, AGENTS[k % AGENTS.length]]));
  if (hello.agents.length > 6) found.push([`… ${hello.agents.length} agents`, AGENTS[6]]);
  return found;
}
