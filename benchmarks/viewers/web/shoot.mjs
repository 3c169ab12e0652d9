// node shoot.mjs CHROMIUM PLAN.json: opens a file in an engine and takes a picture for each camera and time.
// The plan has engine, glb, sky, linear, size, folder, times, and cameras with pose (column-major) and fovy.
import fs from "node:fs";
import http from "node:http";
import path from "node:path";
import { buildSync } from "esbuild";
import puppeteer from "puppeteer-core";

const [executablePath, planFile] = process.argv.slice(2);
const plan = JSON.parse(fs.readFileSync(planFile));
const bundle = buildSync({ entryPoints: [`${plan.engine}.js`], bundle: true, format: "esm", write: false,
  logLevel: "error" }).outputFiles[0].contents;
const style = `<style>body{margin:0}canvas{width:${plan.size}px;height:${plan.size}px;display:block}</style>`;
const files = {
  "/": ["text/html", `<!doctype html>${style}<canvas id="canvas"></canvas><script type="module" src="/a.js"></script>`],
  "/a.js": ["text/javascript", bundle],
  "/scene.glb": ["model/gltf-binary", fs.readFileSync(plan.glb)],
};
const server = http.createServer((request, response) => {
  const [kind, content] = files[request.url] ?? ["text/plain", ""];
  response.writeHead(request.url in files ? 200 : 404, { "content-type": kind }).end(content);
});
await new Promise((done) => server.listen(0, "127.0.0.1", done));
const browser = await puppeteer.launch({
  executablePath, headless: true, protocolTimeout: 600000,
  args: ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
    "--force-color-profile=srgb", "--hide-scrollbars"],
});
const page = await browser.newPage();
page.on("pageerror", (error) => console.error(error.message));
await page.setViewport({ width: plan.size, height: plan.size });
await page.goto(`http://127.0.0.1:${server.address().port}/`);
await page.waitForFunction("window.boot", { timeout: 60000 });
const start = Date.now();
await page.evaluate((given) => window.boot(given), { glb: "/scene.glb", sky: plan.sky, linear: plan.linear });
const boot = Date.now() - start;
for (const [number, camera] of plan.cameras.entries()) {
  await page.evaluate((pose, fovy) => window.look(pose, fovy), camera.pose, camera.fovy);
  for (const [index, time] of plan.times.entries()) {
    let last = "", picture = null;
    for (let tries = 0; tries < 15; tries++) { // until two pictures are equal
      await page.evaluate((t) => window.go(t), time);
      picture = await page.screenshot({ encoding: "base64" });
      if (picture === last) break;
      last = picture;
    }
    fs.writeFileSync(path.join(plan.folder, `${number}_${index}.png`), Buffer.from(picture, "base64"));
  }
}
console.log(JSON.stringify({ boot_ms: boot }));
await browser.close();
server.close();
