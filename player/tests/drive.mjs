// Drives Chromium for the tests: one JSON command per line on stdin, one JSON answer per line on stdout.
// {"open": URL, "width": W, "height": H, "touch": false, "webgl": true, "still": false, "ratio": 1}  {"eval": JS}
// {"key": KEY}  {"type": TEXT}  {"click": [X, Y]}  {"tap": [X, Y]}  {"shot": FILE}  {"log": true}
import readline from "node:readline";
import puppeteer from "puppeteer-core";

const [executablePath] = process.argv.slice(2);
const args = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
  "--force-color-profile=srgb", "--hide-scrollbars"];
let browser = null, webgl = true, page = null, log = [], requests = [];

async function open({ open: url, width, height, touch = false, webgl: wanted = true, still = false, ratio = 1 }) {
  if (browser && wanted !== webgl) { await browser.close(); browser = page = null; }
  webgl = wanted;
  browser ??= await puppeteer.launch({
    executablePath, headless: true, protocolTimeout: 600000,
    args: wanted ? args : ["--no-sandbox", "--disable-gpu", "--disable-3d-apis"],
  });
  await page?.close();
  page = await browser.newPage();
  [log, requests] = [[], []];
  page.on("pageerror", (error) => log.push(String(error.message ?? error)));
  page.on("console", (line) => { if (["error", "warn"].includes(line.type())) log.push(line.text()); });
  page.on("request", (request) => { if (!/^(data|blob):/.test(request.url())) requests.push(request.url()); });
  await page.setViewport({ width, height, hasTouch: touch, isMobile: touch, deviceScaleFactor: ratio });
  if (still) await page.emulateMediaFeatures([{ name: "prefers-reduced-motion", value: "reduce" }]);
  await page.goto(url);
  await page.waitForFunction("window.r5dgs || document.body.classList.contains('failed')", { timeout: 120000 });
}

const commands = {
  open,
  eval: ({ eval: code }) => page.evaluate(code),
  key: ({ key }) => page.keyboard.press(key),
  type: ({ type }) => page.keyboard.type(type),
  click: ({ click: [x, y] }) => page.mouse.click(x, y),
  tap: ({ tap: [x, y] }) => page.touchscreen.tap(x, y),
  shot: async ({ shot }) => { await page.screenshot({ path: shot }); },
  log: () => ({ log, requests }),
};

for await (const line of readline.createInterface({ input: process.stdin })) {
  const command = JSON.parse(line);
  try {
    const name = Object.keys(command)[0];
    console.log(JSON.stringify({ result: (await commands[name](command)) ?? null }));
  } catch (error) {
    console.log(JSON.stringify({ error: String(error.stack ?? error) }));
  }
}
await browser?.close();
