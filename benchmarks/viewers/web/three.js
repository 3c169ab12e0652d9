// three.js; colours are handed over as linear, so the output is left as it is (`linear`), or encoded again by default.
import { GLTFGaussianSplatLoaderExtension } from "three/addons/loaders/GLTFGaussianSplatLoaderExtension.js";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import * as THREE from "three/webgpu";

window.boot = async ({ glb, sky, linear }) => {
  const canvas = document.getElementById("canvas");
  const renderer = new THREE.WebGPURenderer({ canvas, forceWebGL: true, antialias: false });
  await renderer.init();
  renderer.setSize(canvas.clientWidth, canvas.clientHeight, false);
  if (linear) renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
  const clear = new THREE.Color().setRGB(...sky, linear ? THREE.LinearSRGBColorSpace : THREE.SRGBColorSpace);
  renderer.setClearColor(clear, 1);
  const scene = new THREE.Scene();
  const eye = new THREE.PerspectiveCamera(60, canvas.clientWidth / canvas.clientHeight, 0.05, 100);
  const loader = new GLTFLoader();
  loader.register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
  const file = await loader.loadAsync(glb);
  scene.add(file.scene);
  const mixer = new THREE.AnimationMixer(file.scene);
  mixer.clipAction(file.animations[0]).play();
  window.look = (pose, fovy) => {
    eye.matrix.fromArray(pose);
    eye.matrix.decompose(eye.position, eye.quaternion, eye.scale);
    eye.fov = fovy * 180 / Math.PI;
    eye.updateProjectionMatrix();
  };
  window.go = async (time) => {
    mixer.setTime(time);
    for (let k = 0; k < 6; k++) {
      await renderer.renderAsync(scene, eye);
      await new Promise((done) => setTimeout(done, 20));
    }
  };
};
