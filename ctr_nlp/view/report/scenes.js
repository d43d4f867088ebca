/** The scenes: made when the rest of the page is on the screen, coloured, and with parts switched on and off. */

const report = JSON.parse(document.getElementById("data").textContent);
const views = [...document.querySelectorAll(".view")];
const [slider, button, speed, loop, colouring, glass] = ["frame", "play", "speed", "loop", "colouring", "glass"].map(
  (id) => document.getElementById(id),
);
const scenes = report.plans.map(() => null);
let view = "";

/** Put k3d's page with a plan's data where its scene belongs, or say why there is none. */
function makeScene(k, graphics) {
  const place = views[k].querySelector(".scene");
  if (!graphics) {
    place.querySelector(".missing").hidden = false;
    return;
  }
  const frame = document.createElement("iframe");
  frame.title = "The robot, its target and the lumen in three dimensions; drag to turn the view";
  frame.srcdoc = report.template.replace(report.placeholder, () => report.plans[k].scene);
  place.prepend(frame);
}

/** Called by each scene once it is drawn; cameras that are turned by hand move as one. */
function ready(frame, scene) {
  const k = views.findIndex((place) => place.contains(frame));
  scenes[k] = scene;
  const inner = frame.contentDocument;
  inner.addEventListener("keydown", onKey);
  for (const kind of ["pointerdown", "wheel"]) inner.addEventListener(kind, () => look("free"), { capture: true });
  scene.on(scene.events.CAMERA_CHANGE, (numbers) => {
    tellLength(k);
    pointCompass(k);
    if (camera === "free") follow(scene, numbers);
  });
  frame.contentWindow.addEventListener("resize", () => look(camera));
  colour();
  requestAnimationFrame(() => look(camera));
}

/** Give the camera of one scene to all others. */
function follow(scene, numbers) {
  const seen = numbers.map((number) => number.toFixed(3)).join();
  if (seen === view) return;
  view = seen;
  for (const other of scenes) if (other && other !== scene) other.setCamera(numbers);
}

function isOn(part) {
  return document.querySelector(`[data-part="${part}"]`)?.checked ?? true;
}

/**
 * Colour what plans know by the chosen quantity, and other plans by tube; show the parts that are switched on; let
 * the target, and drawn robots, which lie close to the plan, be seen through tubes.
 */
function colour() {
  const key = colouring.value;
  for (const legend of document.querySelectorAll(".legend[data-key]")) legend.hidden = legend.dataset.key !== key;
  for (const legend of document.querySelectorAll(".legend[data-of]")) legend.hidden = !isOn(legend.dataset.of);
  report.plans.forEach((plan, k) => scenes[k] && dress(scenes[k], plan.colourings.includes(key) ? key : plan.colourings[0]));
  show(shown);
}

/**
 * Show the objects of a scene whose part is switched on, tubes by one colouring only. From the tip, the wall is
 * solid and pink, without its rings.
 */
function dress(scene, key) {
  const inside = camera === "eye";
  for (const object of Object.values(scene.getWorld().ObjectsListJson)) {
    const { part, colouring: own } = object.custom_data ?? {};
    if (!part) continue;
    const wall = part === report.endoscope.part;
    const ring = wall && object.type !== "Mesh";
    const visible = isOn(part) && (own === undefined || own === key) && !(ring && inside);
    if (own !== undefined) object.opacity = glass.checked ? 0.4 : 1;
    const painted = wall && !ring && paint(object, inside);
    if (visible === object.visible && !painted) continue;
    object.visible = visible;
    scene.reload(object, null, true);
  }
  light(scene, inside);
}

/** Give a wall its look from within, or from outside; whether that changed it. */
function paint(object, inside) {
  object.outside ??= { color: object.color, opacity: object.opacity };
  const wanted = inside ? { color: report.endoscope.wall, opacity: 1 } : object.outside;
  if (object.color === wanted.color && object.opacity === wanted.opacity) return false;
  Object.assign(object, wanted);
  return true;
}

/** From the tip, light from the tip alone, which fades into the dark; else k3d's own lights on white. */
function light(scene, inside) {
  const world = scene.getWorld();
  scene.setClearColor(inside ? 0 : 0xffffff);
  world.recalculateLights(scene.parameters.lighting);
  // k3d has no option for fog; three.js, which draws it, takes it from the scene.
  world.scene.fog = inside ? darkness(world) : null;
  if (!inside) return;
  for (const lamp of [world.keyLight, world.fillLight, world.backLight]) lamp.intensity = 0;
  world.headLight.intensity = report.endoscope.light;
  // A lamp at the tip lights walls beside it, too, which k3d's, a parallel beam, does not.
  world.scene.children.find((child) => child.isAmbientLight).intensity = report.endoscope.glow;
}

/** Darkness that grows with the distance from the camera, as three.js describes fog. */
function darkness(world) {
  const color = world.keyLight.color.clone().setHex(0);
  return { isFog: true, name: "", color, near: 0, far: report.endoscope.dark };
}

/** A picture of each chosen frame of each plan for the print, as the scenes are seen now. */
async function drawPrints() {
  for (const [k, plan] of report.plans.entries()) {
    const scene = scenes[k];
    if (!scene) continue;
    const drawn = [];
    for (const { name, frame } of plan.prints) {
      showPlan(plan, k, frame, frame);
      await scene.setTime(frame);
      await scene.getWorld().render(true);
      drawn.push(printed(`${name}, ${frame + 1} of ${plan.time.length}: ${arrivalText(plan, frame)}`, scene));
    }
    views[k].querySelector(".prints").replaceChildren(...drawn);
  }
  show(shown);
}

/** A picture of a scene as it is now, with a caption. */
function printed(caption, scene) {
  const figure = document.createElement("figure");
  const image = document.createElement("img");
  image.src = scene.getWorld().renderer.domElement.toDataURL();
  image.alt = `The robot, its target and the lumen; ${caption}`;
  const words = document.createElement("figcaption");
  words.textContent = caption;
  figure.append(image, words);
  return figure;
}

/** Before the browser prints on its own, which waits for nothing: at least the frame that is shown. */
function drawShown() {
  scenes.forEach((scene, k) => {
    const place = views[k].querySelector(".prints");
    if (scene && !place.childElementCount) place.append(printed(document.getElementById("moment").textContent, scene));
  });
}

/** Print with pictures of the chosen frames. */
async function printPage() {
  stop();
  await drawPrints();
  await Promise.all([...document.querySelectorAll(".prints img")].map((image) => image.decode()));
  print();
}
