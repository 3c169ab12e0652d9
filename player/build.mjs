// Builds the page of the player into one file: node build.mjs [FILE]
import fs from "node:fs";
import path from "node:path";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const here = path.dirname(fileURLToPath(import.meta.url));
const target = process.argv[2] ?? path.join(here, "..", "r5dgs_core", "formats", "player.html");
const read = (...parts) => fs.readFileSync(path.join(here, ...parts), "utf8");

// The engine sorts into 2^10 to 2^20 buckets of depth, by the number of Gaussians; few buckets show wrong orders.
const exactSort = {
  name: "exact sort",
  setup: ({ onLoad }) => onLoad({ filter: /gsplat-unified-sort-worker\.js$/ }, ({ path: file }) => {
    const before = "Math.max(10, Math.min(20, Math.round(Math.log2(numVertices / 4))))", text = fs.readFileSync(file, "utf8");
    if (!text.includes(before)) throw new Error(`${file}: expected ${before}`);
    return { contents: text.replace(before, "20"), loader: "js" };
  }),
};

const bundle = async (entry, options) => {
  const result = await build({
    entryPoints: [path.join(here, "src", entry)], absWorkingDir: here, bundle: true, minify: true, write: false,
    legalComments: "none", charset: "utf8", logLevel: "error", target: "es2022", ...options,
  });
  return result.outputFiles[0].text.trim();
};

const script = await bundle("main.ts", { format: "iife", plugins: [exactSort] });
const style = await bundle("style.css", {});
const { version } = JSON.parse(read("node_modules", "playcanvas", "package.json"));
const licences = [
  "Player of R5DGS: GPL-3.0-or-later. It contains PlayCanvas " + version + ":",
  read("node_modules", "playcanvas", "LICENSE").trim(),
].join("\n").replaceAll("--", "- -");
const parts = { STYLE: style, LICENCES: licences, SCRIPT: script.replaceAll("</script", "<\\/script").replaceAll("<!--", "<\\!--") };
const page = read("src", "page.html").replace(/\{\{(STYLE|LICENCES|SCRIPT)\}\}/g, (_, name) => parts[name]);
fs.writeFileSync(target, page);
console.log(`${target}: ${page.length} characters`);
