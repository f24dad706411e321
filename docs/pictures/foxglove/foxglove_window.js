// Opens a bag in Foxglove Studio, in a browser without a display, and saves a picture of its window.
//
//     npm install --no-save react@17 react-dom@17 @foxglove/studio-base@1.48.0 \
//         @sparticuz/chromium puppeteer-core
//     node docs/pictures/foxglove/foxglove_window.js ros2_bag/ros2_bag.mcap foxglove.png \
//         [image=TOPIC] [cloud=TOPIC] [raw=TOPIC] [frame=FRAME] [seconds=N]
//
// Run it in the folder that has node_modules. Version 1.48.0 is the last one on npm, under the
// Mozilla Public License 2.0. The program ends with 1 if the page reports an error.

const fs = require("fs");
const http = require("http");
const path = require("path");
const {createRequire} = require("module");

const here = createRequire(path.join(process.cwd(), "package.json"));
const packed = here("@sparticuz/chromium");
const chromium = packed.default || packed;
const puppeteer = here("puppeteer-core");

const [bag, picture, ...words] = process.argv.slice(2);
const options = new URLSearchParams({
  image: "/car_0/front_rgb/image_raw",
  cloud: "/car_0/roof_lidar/points",
  raw: "/car_0/imu",
  frame: "car_0/base_link",
  ...Object.fromEntries(words.map((word) => word.split("="))),
});
const types = {".html": "text/html", ".js": "text/javascript", ".wasm": "application/wasm"};

function fileOf(url) {
  const name = decodeURIComponent(new URL(url, "http://localhost").pathname);
  if (name === "/") return path.join(__dirname, "foxglove_window.html");
  if (name === "/bag.mcap") return bag;
  return path.join(process.cwd(), "node_modules", path.normalize(name.replace(/^\/npm/, "")));
}

// The studio reads parts of the bag.
function answer(request, response) {
  const file = fileOf(request.url);
  if (!fs.existsSync(file)) {
    response.writeHead(404);
    response.end();
    return;
  }
  const size = fs.statSync(file).size;
  const range = /bytes=(\d+)-(\d*)/.exec(request.headers.range || "");
  const start = range ? Number(range[1]) : 0;
  const end = range && range[2] ? Math.min(Number(range[2]), size - 1) : size - 1;
  response.writeHead(range ? 206 : 200, {
    "content-type": types[path.extname(file)] || "application/octet-stream",
    "accept-ranges": "bytes",
    "content-length": end - start + 1,
    ...(range && {"content-range": `bytes ${start}-${end}/${size}`}),
  });
  if (request.method === "HEAD") response.end();
  else fs.createReadStream(file, {start, end}).pipe(response);
}

async function look(port) {
  const browser = await puppeteer.launch({
    executablePath: await chromium.executablePath(),
    headless: "shell",
    args: ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader",
           "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"],
    defaultViewport: {width: 1200, height: 700},
  });
  const errors = [];
  try {
    const page = await browser.newPage();
    page.on("pageerror", (error) => errors.push(String(error)));
    await page.goto(`http://127.0.0.1:${port}/?${options}`, {timeout: 120_000});
    const seconds = Number(options.get("seconds") || 30);
    await new Promise((resolve) => setTimeout(resolve, 1000 * seconds));
    await page.screenshot({path: picture});
    console.log(await page.evaluate(() => document.body.innerText));
  } finally {
    await browser.close();
  }
  errors.forEach((error) => console.error(error));
  return errors.length ? 1 : 0;
}

const server = http.createServer(answer).listen(0, "127.0.0.1", async () => {
  process.exitCode = await look(server.address().port).finally(() => server.close());
});
