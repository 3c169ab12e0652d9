// Pointer, wheel and flight keys on the picture.
import type { Player } from "./player.ts";

const TURN = 0.006; // rad per pixel
const CLICK = 5; // pixels
const PACE = 0.35; // of the scene's extent per second
const FLIGHT: Record<string, [number, number, number]> = {
  w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, -1, 0], e: [0, 1, 0],
};

export function control(canvas: HTMLCanvasElement, player: Player): void {
  const down = new Map<number, { x: number; y: number; button: number }>();
  let wandered = 0, gap = 0;
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    if (!down.size) wandered = 0;
    down.set(event.pointerId, { x: event.clientX, y: event.clientY, button: event.button });
    gap = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const was = down.get(event.pointerId);
    if (!was) return;
    const dx = event.clientX - was.x, dy = event.clientY - was.y, views = player.views;
    wandered += Math.abs(dx) + Math.abs(dy);
    down.set(event.pointerId, { ...was, x: event.clientX, y: event.clientY });
    if (wandered < CLICK) return;
    const share = Math.min(canvas.clientWidth, canvas.clientHeight);
    if (down.size === 2) {
      const [a, b] = [...down.values()], now = Math.hypot(a.x - b.x, a.y - b.y);
      if (gap) views.zoom(gap / now);
      views.pan(dx / share / 2, dy / share / 2);
      gap = now;
    } else if (was.button === 2 || event.shiftKey) views.pan(dx / share, dy / share);
    else views.turn(dx * TURN, dy * TURN);
    player.moved();
  });
  const up = (event: PointerEvent) => {
    const was = down.get(event.pointerId);
    down.delete(event.pointerId);
    gap = 0;
    if (event.type === "pointerup" && was?.button === 0 && wandered < CLICK && !down.size) {
      player.choose(player.pick(event.offsetX, event.offsetY));
    }
  };
  canvas.addEventListener("pointerup", up);
  canvas.addEventListener("pointercancel", up);
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    player.views.zoom(Math.exp(event.deltaY * 0.001));
    player.moved();
  }, { passive: false });
  flight(player);
}

function flight(player: Player): void {
  const held = new Set<string>();
  let last = 0;
  const step = (now: number) => {
    const seconds = Math.min(0.1, (now - last) / 1000);
    last = now;
    for (const key of held) {
      const [x, y, z] = FLIGHT[key].map((share) => share * PACE * seconds);
      player.views.fly(x, y, z);
    }
    player.moved();
    if (held.size) requestAnimationFrame(step);
  };
  addEventListener("keydown", (event) => {
    const key = event.key.toLowerCase(), target = event.target as HTMLElement;
    if (!(key in FLIGHT) || !player.views.flying || event.ctrlKey || event.metaKey || target.tagName === "INPUT") return;
    if (!held.size) {
      last = performance.now();
      requestAnimationFrame(step);
    }
    held.add(key);
  });
  addEventListener("keyup", (event) => held.delete(event.key.toLowerCase()));
  addEventListener("blur", () => held.clear());
}
