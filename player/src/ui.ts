// Controls of the page around the state of the player.
import type { Model, SceneObject } from "./model.ts";
import type { Player } from "./player.ts";
import { widthAt } from "./overlay.ts";
import { Search } from "./search/search.ts";

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];
const eyeOf = (inside: string): string =>
  `<svg viewBox="0 0 24 24" width="20" height="20" fill="none" stroke="currentColor" stroke-width="1.8" aria-hidden="true">${inside}</svg>`;
const EYE = eyeOf('<path d="M2 12s4-7 10-7 10 7 10 7-4 7-10 7S2 12 2 12z"/><circle cx="12" cy="12" r="3"/>');
const CLOSED = eyeOf('<path d="M2 12s4 6 10 6 10-6 10-6M4 20 20 4"/>');
const HELP: [string, string][] = [
  ["Space", "play or pause"], ["← →", "previous or next frame; with Shift ten frames"], ["Home, End", "first or last time"],
  ["/", "find objects"], ["I", "isolate the picked object"], ["V", "show or hide the picked object"], ["Esc", "pick nothing, end the isolation"],
  ["C", "next captured camera"], ["F", "fly or orbit"], ["W A S D, Q E", "fly: move"],
  ["Drag, wheel", "turn, zoom; right button or two fingers shift the view"], ["Click, tap", "pick an object"],
];

export const element = <T extends HTMLElement>(id: string): T => document.getElementById(id) as T;

function made<K extends keyof HTMLElementTagNameMap>(tag: K, text = "", className = ""): HTMLElementTagNameMap[K] {
  const found = document.createElement(tag);
  found.textContent = text;
  if (className) found.className = className;
  return found;
}

export class Controls {
  private readonly model: Model;
  readonly search: Search;
  private readonly rows = new Map<number, HTMLLIElement>();

  constructor(private readonly player: Player, labels: { id: number; name: string; aliases: string[] }[]) {
    this.model = player.model;
    this.search = new Search(labels.filter((label) => label.id >= 0), this.model.words);
    this.clock();
    this.list();
    this.tools();
    this.about();
    this.keys();
    const fold = element<HTMLButtonElement>("fold");
    const open = (on: boolean) => {
      fold.setAttribute("aria-expanded", String(on));
      document.body.classList.toggle("open", on);
    };
    fold.onclick = () => open(fold.getAttribute("aria-expanded") === "false");
    open(!matchMedia("(max-width: 640px)").matches);
  }

  private clock(): void {
    const { model, player } = this, slider = element<HTMLInputElement>("time");
    slider.min = String(model.start);
    slider.max = String(model.end);
    const seen = (100 * (model.tMax - model.start)) / Math.max(model.end - model.start, 1e-12);
    document.documentElement.style.setProperty("--seen", `${seen}%`);
    document.body.classList.toggle("whole", !(model.end > model.tMax));
    document.body.classList.toggle("static", !model.motion.moves);
    slider.oninput = () => { player.play(false); player.go(Number(slider.value)); };
    element("play").onclick = () => player.play(!player.playing);
  }

  // Show time, playing state and picked object.
  show(): void {
    const { model, player } = this, future = player.t > model.tMax + 1e-9;
    const slider = element<HTMLInputElement>("time"), button = element("play");
    slider.value = String(player.t);
    const text = `${player.t.toFixed(2)} ${future ? "predicted" : "observed"}`;
    if (element("now").textContent !== text) {
      element("now").textContent = text;
      slider.setAttribute("aria-valuetext", text);
      document.body.classList.toggle("future", future);
    }
    button.textContent = player.playing ? "❚❚" : "▶";
    button.setAttribute("aria-label", player.playing ? "Pause" : "Play");
  }

  private list(): void {
    const list = element("objects"), input = element<HTMLInputElement>("search");
    for (const item of this.model.objects) {
      const row = made("li"), name = made("button", "", "name"), swatch = made("i", "", "swatch"), eye = made("button", "", "eye");
      swatch.style.background = `rgb(${item.color.map((c) => Math.round(255 * c))})`;
      name.append(swatch, made("span", item.name), made("small", "", "score"));
      name.onclick = () => this.player.choose(this.player.chosen === item.id ? null : item.id);
      eye.onclick = () => this.player.setVisible(item.id, !this.player.visible(item.id));
      row.append(name, eye);
      list.append(row);
      this.rows.set(item.id, row);
    }
    input.oninput = () => this.find(input.value);
    input.onkeydown = (event) => {
      const first = list.querySelector<HTMLElement>("li:not([hidden]) .name");
      if (event.key === "Enter" && input.value.trim() && first) first.click();
      if (event.key === "Escape") { input.value = ""; this.find(""); input.blur(); }
      event.stopPropagation();
    };
  }

  // Show the objects that match, best first, or all for an empty text. Returns the ids.
  find(text: string): number[] {
    const list = element("objects"), asked = text.trim() !== "";
    const { matches, note } = asked ? this.search.find(text) : { matches: [], note: "" };
    const ids = asked ? matches.map((match) => match.id).filter((id) => this.rows.has(id)) : [...this.rows.keys()];
    for (const [id, row] of this.rows) row.hidden = !ids.includes(id);
    for (const id of ids) {
      const row = this.rows.get(id)!, match = matches.find((one) => one.id === id);
      row.querySelector(".score")!.textContent = match ? match.score.toFixed(2) : "";
      row.title = match?.why ?? "";
      list.append(row);
    }
    element("note").textContent = note;
    return ids;
  }

  // Show which objects are visible and picked.
  marks(): void {
    for (const [id, row] of this.rows) {
      const on = this.player.visible(id), picked = this.player.chosen === id, item = this.model.object(id)!;
      row.classList.toggle("chosen", picked);
      row.classList.toggle("gone", !on);
      const [name, eye] = [row.querySelector(".name")!, row.querySelector<HTMLElement>(".eye")!];
      name.setAttribute("aria-pressed", String(picked));
      eye.innerHTML = on ? EYE : CLOSED;
      eye.setAttribute("aria-label", `${on ? "Hide" : "Show"} ${item.name}`);
      eye.setAttribute("aria-pressed", String(on));
    }
    this.picked();
  }

  private picked(): void {
    const info = element("info"), { player, model } = this;
    info.replaceChildren();
    const item = player.chosen === null ? undefined : model.object(player.chosen);
    if (!item) return;
    info.append(made("h2", item.name));
    if (item.caption) info.append(made("p", item.caption));
    const { warning } = item.prediction; // has its own line
    const motion = warning ? item.motion.replaceAll(`; ${warning}`, "").replaceAll(`, ${warning}`, "") : item.motion;
    info.append(made("p", `Motion: ${motion}`), ...this.confidence(item));
    const isolate = made("button", player.isolated === item.id ? "Show all" : "Isolate");
    isolate.onclick = () => player.isolate(player.isolated === item.id ? null : item.id);
    const focus = made("button", "Look at");
    focus.onclick = () => player.focus(item.id);
    info.append(isolate, focus);
  }

  private confidence(item: SceneObject): HTMLElement[] {
    const { warning, half_width: width, half_width_percent: percent } = item.prediction, found: HTMLElement[] = [];
    const band = this.model.bodyOf(item.id)?.band;
    if (width !== null && width !== undefined && band) {
      const at = widthAt(band, this.model.end);
      const share = width > 0 ? ` (${((at * (percent ?? 0)) / width).toPrecision(2)} % of its size)` : "";
      found.push(made("p", `Confidence: ± ${at.toPrecision(2)}${share} at t = ${this.model.end.toPrecision(3)}, ${Math.round(100 * band.level)} %`));
    }
    if (warning) found.push(made("p", warning, "warning"));
    return found;
  }

  private tools(): void {
    const { player, model } = this;
    const loop = element<HTMLInputElement>("loop"), speed = element<HTMLSelectElement>("speed");
    loop.onchange = () => { player.loop = loop.checked; };
    for (const value of SPEEDS) speed.append(new Option(`${value}×`, String(value), value === 1, value === 1));
    speed.onchange = () => { player.speed = Number(speed.value); };
    const mode = element<HTMLSelectElement>("mode");
    for (const name of model.modes) mode.append(new Option(name, name));
    mode.onchange = () => player.setMode(mode.value);
    element("modes").hidden = model.modes.length < 2;
    const camera = element<HTMLSelectElement>("camera");
    camera.append(new Option("Orbit", "orbit"), new Option("Fly", "fly"));
    model.cameras.forEach((one, number) => camera.append(new Option(one.name || `camera ${number}`, String(number))));
    camera.onchange = () => { player.setCamera(camera.value); camera.blur(); };
    const vr = element<HTMLButtonElement>("vr"), offer = () => { vr.hidden = !player.engine.canEnterVr; };
    player.engine.onVr(offer);
    offer();
    vr.onclick = () => player.engine.enterVr((text) => this.say(text));
  }

  cameraName(value: string): void { element<HTMLSelectElement>("camera").value = value; }

  say(text: string): void {
    const message = element("message");
    message.textContent = text;
    message.classList.add("error");
    setTimeout(() => message.classList.remove("error"), 6000);
  }

  private about(): void {
    const about = element("about"), button = element("help");
    const keys = made("dl");
    for (const [key, what] of HELP) keys.append(made("dt", key), made("dd", what));
    about.append(made("strong", this.model.name || "Scene"), keys);
    const lost = this.model.lost.filter((one) => !/in other programs/.test(one));
    if (lost.length) {
      const list = made("ul");
      lost.forEach((one) => list.append(made("li", one)));
      about.append(made("p", "This file does not hold:"), list);
    }
    button.onclick = () => {
      about.hidden = !about.hidden;
      button.setAttribute("aria-expanded", String(!about.hidden));
    };
  }

  private keys(): void {
    const { player } = this;
    addEventListener("keydown", (event) => {
      const target = event.target as HTMLElement;
      if (event.ctrlKey || event.metaKey || event.altKey || target.tagName === "SELECT") return;
      if (event.key === " " && target.tagName === "BUTTON") return;
      const step = (event.shiftKey ? 10 : 1) * this.model.frame;
      const move = (t: number) => { player.play(false); player.go(t); };
      const does: Record<string, () => void> = {
        " ": () => player.play(!player.playing),
        ArrowLeft: () => move(player.t - step), ArrowRight: () => move(player.t + step),
        Home: () => move(this.model.start), End: () => move(this.model.end),
        "/": () => { element("search").focus(); },
        i: () => player.isolate(player.isolated === null ? player.chosen : null),
        v: () => { if (player.chosen !== null) player.setVisible(player.chosen, !player.visible(player.chosen)); },
        c: () => player.nextCamera(), f: () => player.setCamera(player.views.flying ? "orbit" : "fly"),
        Escape: () => { player.isolate(null); player.choose(null); },
      };
      const action = does[event.key] ?? does[event.key.toLowerCase()];
      if (!action || (event.key.length === 1 && target.tagName === "INPUT" && target.id === "search")) return;
      event.preventDefault();
      action();
    });
  }
}
