/** The scenes: made when the rest of the page is on the screen, coloured, and with parts switched on and off. */

const report = JSON.parse(document.getElementById("data").textContent);
const sections = [...document.querySelectorAll(".plan")];
const [slider, button, speed, loop, colouring, glass] = ["frame", "play", "speed", "loop", "colouring", "glass"].map(
  (id) => document.getElementById(id),
);
const scenes = report.plans.map(() => null);
let view = "";

/** Put k3d's page with a plan's data where its scene belongs, or say why there is none. */
function makeScene(k, graphics) {
  const place = sections[k].querySelector(".scene");
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
  const k = sections.findIndex((section) => section.contains(frame));
  scenes[k] = scene;
  const inner = frame.contentDocument;
  inner.addEventListener("keydown", onKey);
  for (const kind of ["pointerdown", "wheel"]) inner.addEventListener(kind, () => look("free"), { capture: true });
  scene.on(scene.events.CAMERA_CHANGE, (numbers) => {
    tellLength(k);
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

/** Show the objects of a scene whose part is switched on, tubes by one colouring only. */
function dress(scene, key) {
  for (const object of Object.values(scene.getWorld().ObjectsListJson)) {
    const { part, colouring: own } = object.custom_data ?? {};
    if (!part) continue;
    const visible = isOn(part) && (own === undefined || own === key);
    if (own !== undefined) object.opacity = glass.checked ? 0.4 : 1;
    if (visible === object.visible) continue;
    object.visible = visible;
    scene.reload(object, null, true);
  }
}

/** Before the page is printed, which cannot ask a scene: its picture as it is shown. */
function picture() {
  scenes.forEach((scene, k) => {
    if (!scene) return;
    sections[k].querySelector(".printed").src = scene.getWorld().renderer.domElement.toDataURL();
  });
}
