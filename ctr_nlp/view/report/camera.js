/** The cameras of all scenes: presets, the tip's eye, turning by keys, and the bar that tells lengths. */

const BAR = 90; // pixels that the bar is about as long as
const NICE = [1, 2, 5];
let camera = "side";

/** A preset moved away from what it looks at, so that what fits a square window also fits a narrow one. */
function fitted(preset, aspect) {
  const far = Math.max(1, 1 / aspect);
  return preset.map((number, i) => (i < 3 ? preset[i + 3] + far * (number - preset[i + 3]) : number));
}

/** The tip's eye at a place between frames; null where the robot has no shape. */
function eyeAt(plan, exact) {
  const [before, after] = [plan.eyes[Math.floor(exact)], plan.eyes[Math.ceil(exact)]];
  if (!before || !after) return before || after;
  return before.map((number, i) => number + (exact % 1) * (after[i] - number));
}

/** Choose "side", "top" or "eye", or leave all scenes as they are: "free". */
function look(name) {
  camera = name;
  for (const button of document.querySelectorAll("[data-camera]")) {
    button.setAttribute("aria-pressed", button.dataset.camera === name);
  }
  if (name === "free") return;
  const field = report.fields[name === "eye" ? "eye" : "outside"];
  scenes.forEach((scene) => {
    if (!scene) return;
    scene.parameters.cameraFov = field;
    scene.getWorld().setupCamera(null, field);
    if (name !== "eye") scene.setCamera(fitted(report.cameras[name], aspectOf(scene)));
  });
  colour();
}

function aspectOf(scene) {
  const place = scene.getWorld().targetDOMNode;
  return place.offsetWidth / place.offsetHeight;
}

/** The nine numbers of a scene's camera: position, point looked at, upward direction. */
function cameraOf(scene) {
  return scene.getWorld().controls.getCameraArray();
}

/** What lies right of and above the line of sight, turned by angles in rad about the point looked at. */
function turned(numbers, across, up) {
  const [eye, middle, top] = [0, 3, 6].map((at) => numbers.slice(at, at + 3));
  const away = eye.map((number, i) => number - middle[i]);
  const right = cross(top, away);
  const lifted = rotated(away, right, -up);
  return [...rotated(lifted, top, across).map((number, i) => number + middle[i]), ...middle,
    ...rotated(rotated(top, right, -up), top, across)];
}

function cross(a, b) {
  return [0, 1, 2].map((i) => a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3]);
}

/** A vector turned about an axis by an angle in rad (Rodrigues). */
function rotated(vector, axis, angle) {
  const around = unit(axis);
  const along = around.reduce((sum, number, i) => sum + number * vector[i], 0);
  const side = cross(around, vector);
  return vector.map((number, i) =>
    number * Math.cos(angle) + side[i] * Math.sin(angle) + around[i] * along * (1 - Math.cos(angle)));
}

/** Turn all scenes by steps of 10 degrees. */
function turn(across, up) {
  look("free");
  const step = Math.PI / 18;
  for (const scene of scenes) if (scene) scene.setCamera(turned(cameraOf(scene), across * step, up * step));
}

/** Point the letters of a scene's axes where these lie on the screen. */
function pointCompass(k) {
  const compass = views[k].querySelector(".compass");
  const numbers = cameraOf(scenes[k]);
  const away = [0, 1, 2].map((i) => numbers[i] - numbers[i + 3]);
  const right = unit(cross(numbers.slice(6), away));
  const up = unit(cross(away, right));
  compass.removeAttribute("hidden");
  compass.innerHTML = report.plans[k].coordinates.axes.map(({ letters, direction }) => {
    const [x, y] = [right, up].map((side, i) => (i ? -1 : 1) * side.reduce((sum, part, j) => sum + part * direction[j], 0));
    const line = `<path d="M${-30 * x} ${-30 * y}L${30 * x} ${30 * y}"/>`;
    // An axis that points at the viewer has no room for its letters.
    if (Math.hypot(x, y) < 0.3) return line;
    const [first, second] = [1, -1].map((end) => `x="${40 * end * x}" y="${40 * end * y}"`);
    return `${line}<text ${first}>${letters[0]}</text><text ${second}>${letters[1]}</text>`;
  }).join("");
}

function unit(vector) {
  const length = Math.hypot(...vector);
  return vector.map((number) => number / length);
}

/** How long 90 pixels are at the point looked at, as the nearest round number of mm. */
function tellLength(k) {
  const [scene, bar] = [scenes[k], views[k].querySelector(".length")];
  const numbers = cameraOf(scene);
  const far = Math.hypot(...[0, 1, 2].map((i) => numbers[i] - numbers[i + 3]));
  const height = scene.getWorld().targetDOMNode.offsetHeight;
  if (!height || !far) return;
  const pixel = (2 * far * Math.tan((scene.parameters.cameraFov * Math.PI) / 360)) / height;
  const ten = 10 ** Math.floor(Math.log10(pixel * BAR));
  const told = NICE.map((number) => number * ten).findLast((number) => number <= pixel * BAR);
  bar.hidden = camera === "eye";
  bar.style.setProperty("--long", `${told / pixel}px`);
  bar.textContent = `${Number(told.toPrecision(1))} mm`;
}
