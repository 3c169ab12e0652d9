// Start of the page: reads the scene that it contains, and the parameters of its address.
import { Engine } from "./engine.ts";
import { Model } from "./model.ts";
import { Player } from "./player.ts";
import { control } from "./pointer.ts";
import { element } from "./ui.ts";

declare global { interface Window { r5dgs?: Player } }

function content(): ArrayBuffer {
  const text = atob(element("scene").textContent!.trim());
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes.buffer;
}

function fail(text: string): void {
  document.body.classList.remove("ready");
  document.body.classList.add("failed");
  element("message").textContent = text;
}

const hasWebGl = (): boolean => {
  const found = document.createElement("canvas").getContext("webgl2");
  found?.getExtension("WEBGL_lose_context")?.loseContext();
  return found !== null;
};

const brief = (t: number): string => String(Number(t.toPrecision(3)));

// ?t=0.5&object=mug&camera=front&ui=0
function follow(player: Player, address: URLSearchParams): void {
  const { model } = player, time = address.get("t"), object = address.get("object"), camera = address.get("camera");
  const t = time?.trim() ? Number(time) : NaN, refused: string[] = [];
  if (address.get("ui") === "0") document.body.classList.add("bare");
  if (camera !== null) {
    const named = model.cameras.findIndex((one) => one.name === camera);
    const number = named < 0 ? model.cameras.findIndex((_, k) => String(k) === camera) : named;
    if (number < 0 && camera !== "fly" && camera !== "orbit") refused.push(`no camera “${camera}” in this scene`);
    else player.setCamera(number < 0 ? camera : String(number));
  }
  if (object !== null) {
    const [id] = player.controls.find(object);
    if (id === undefined) refused.push(`nothing matches “${object}”`);
    else player.choose(id);
    player.controls.find("");
  }
  if (time !== null && !Number.isFinite(t)) refused.push(`t=${time} is not a time`);
  if (Number.isFinite(t)) {
    player.go(t);
    if (player.t !== t) refused.push(`t=${time} is outside this scene, which lasts from ${brief(model.start)} to ${brief(model.end)}`);
  }
  else if (!matchMedia("(prefers-reduced-motion: reduce)").matches) player.play(true);
  if (refused.length) player.controls.say(refused.join("; "));
}

async function main(): Promise<void> {
  if (!hasWebGl()) {
    fail("This browser cannot show the scene in 3D, because WebGL 2 is missing or switched off. This is a picture of it.");
    return;
  }
  const model = new Model(content()), canvas = element<HTMLCanvasElement>("view");
  const engine = await Engine.create(canvas, model);
  const player = new Player(model, engine, model.labels);
  control(canvas, player);
  canvas.addEventListener("webglcontextlost", () => fail("The graphics driver stopped. Load the page again."));
  follow(player, new URLSearchParams(location.search));
  document.body.classList.add("ready");
  window.r5dgs = player;
}

main().catch((error: Error) => fail(`The scene cannot be shown: ${error.message}`));
