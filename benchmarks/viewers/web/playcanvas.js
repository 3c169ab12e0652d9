// PlayCanvas with its defaults, beside the repetition of sorting requests that it drops while its worker is busy.
import * as pc from "playcanvas";

window.boot = async ({ glb, sky }) => {
  const canvas = document.getElementById("canvas");
  const device = await pc.createGraphicsDevice(canvas, {
    deviceTypes: ["webgl2"], antialias: false, preserveDrawingBuffer: true,
  });
  const options = new pc.AppOptions();
  options.graphicsDevice = device;
  options.componentSystems = [pc.CameraComponentSystem, pc.GSplatComponentSystem, pc.AnimComponentSystem,
    pc.RenderComponentSystem];
  options.resourceHandlers = [pc.ContainerHandler, pc.TextureHandler, pc.GSplatHandler];
  const app = new pc.AppBase(canvas);
  app.init(options);
  app.setCanvasFillMode(pc.FILLMODE_NONE, canvas.clientWidth, canvas.clientHeight);
  app.setCanvasResolution(pc.RESOLUTION_AUTO);
  app.start();
  const eye = new pc.Entity();
  eye.addComponent("camera", { clearColor: new pc.Color(...sky), nearClip: 0.05, farClip: 100,
    toneMapping: pc.TONEMAP_NONE });
  app.root.addChild(eye);
  const asset = new pc.Asset("scene", "container", { url: glb, filename: "scene.glb" });
  await new Promise((done, failed) => {
    asset.once("load", done);
    asset.once("error", failed);
    app.assets.add(asset);
    app.assets.load(asset);
  });
  const root = asset.resource.instantiateRenderEntity();
  app.root.addChild(root);
  app.on("update", () => {
    for (const camera of app.renderer.gsplatDirector?.camerasMap?.values() ?? [])
      for (const layer of camera.layersMap?.values() ?? [])
        if (layer.gsplatManager) layer.gsplatManager.sortNeeded = true;
  });
  root.addComponent("anim", { activate: true });
  root.anim.assignAnimation("motion", asset.resource.animations[0].resource);
  root.anim.speed = 0;
  window.look = (pose, fovy) => {
    const matrix = new pc.Mat4();
    matrix.set(pose);
    eye.setPosition(matrix.getTranslation());
    eye.setRotation(new pc.Quat().setFromMat4(matrix));
    eye.camera.fov = fovy * 180 / Math.PI;
  };
  window.go = async (time) => {
    root.anim.baseLayer.activeStateCurrentTime = time;
    await new Promise((done) => setTimeout(done, 200));
  };
};
