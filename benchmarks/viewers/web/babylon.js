// Babylon.js with its defaults.
import "@babylonjs/core/Animations/animatable.js";
import "@babylonjs/core/Shaders/gaussianSplatting.fragment.js";
import "@babylonjs/core/Shaders/gaussianSplatting.vertex.js";
import "@babylonjs/loaders/glTF/index.js";
import { FreeCamera } from "@babylonjs/core/Cameras/freeCamera.js";
import { Engine } from "@babylonjs/core/Engines/engine.js";
import { ImportMeshAsync } from "@babylonjs/core/Loading/sceneLoader.js";
import { Color4 } from "@babylonjs/core/Maths/math.color.js";
import { Matrix, Quaternion, Vector3 } from "@babylonjs/core/Maths/math.vector.js";
import { Scene } from "@babylonjs/core/scene.js";

window.boot = async ({ glb, sky }) => {
  const engine = new Engine(document.getElementById("canvas"), false, { preserveDrawingBuffer: true });
  const scene = new Scene(engine);
  scene.useRightHandedSystem = true;
  scene.clearColor = new Color4(...sky, 1);
  const eye = new FreeCamera("eye", Vector3.Zero(), scene);
  [eye.minZ, eye.maxZ, eye.rotationQuaternion] = [0.05, 100, new Quaternion()];
  await ImportMeshAsync(glb, scene, { pluginExtension: ".glb" });
  const motion = scene.animationGroups[0];
  motion.start(false);
  motion.pause();
  const rate = motion.targetedAnimations[0].animation.framePerSecond;
  window.look = (pose, fovy) => {
    const [turn, place] = [new Quaternion(), new Vector3()];
    Matrix.FromArray(pose).decompose(new Vector3(), turn, place);
    [eye.position, eye.rotationQuaternion, eye.fov] = [place, turn, fovy];
  };
  window.go = async (time) => {
    motion.goToFrame(time * rate);
    for (let k = 0; k < 10; k++) {
      scene.render();
      await new Promise((done) => setTimeout(done, 20));
    }
  };
};
