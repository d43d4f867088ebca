/** Plots and numbers of the frame that is shown, and what the controls do. */

const NUMBER = new Intl.NumberFormat("en", {
  minimumSignificantDigits: 3,
  maximumSignificantDigits: 3,
  useGrouping: false,
});

/** Show a frame of a plan in its scene, plots and numbers; exact: its place, which may be between frames. */
function showPlan(plan, k, frame, exact) {
  const scene = scenes[k];
  if (scene) {
    scene.setTime(exact);
    const eye = camera === "eye" && eyeAt(plan, exact);
    if (eye) scene.setCamera(eye);
  }
  plan.plots.forEach((plot, p) => mark(plots[k][p], plot, plan.time[frame], frame));
  told[k].querySelector(".readout").textContent = readout(plan, frame);
  told[k].querySelector(".places").textContent = places(plan, frame);
  arrivals[k].textContent = arrivalText(plan, frame);
  arrivals[k].classList.toggle("near", (plan.toGo.distance[frame] ?? Infinity) <= plan.toGo.allowed);
}

/** Move a plot's cursor to a frame, and tell its values there. */
function mark(place, plot, time, frame) {
  place.querySelector(".cursor").style.left = `${(100 * time) / plot.end}%`;
  place.querySelectorAll("output").forEach((output, i) => {
    const value = plot.lines[i][frame];
    output.textContent = value === null ? "–" : NUMBER.format(value).replace("-", "−");
  });
}

/** How far the tip is from the target's end in a frame. */
function arrivalText(plan, j) {
  const [distance, angle] = [plan.toGo.distance[j], plan.toGo.angle[j]];
  if (distance === null) return "tip not known";
  return `tip ${distance.toFixed(1)} mm, ${angle.toFixed(0)}° to go`;
}

/** Where tip and deepest contact are in a frame, in the coordinates of the scan. */
function places(plan, j) {
  const { name, tip, nearest, depth } = plan.coordinates;
  if (!tip[j]) return "";
  const found = [`At the frame: tip at ${point(tip[j])} mm in ${name}`];
  if (!nearest[j]) found.push("contact: NOT CHECKED, no wall is known");
  else if (depth[j] > 0) found.push(`deepest contact ${depth[j].toFixed(2)} mm at ${point(nearest[j])}`);
  else found.push(`no contact, ${(-depth[j]).toFixed(2)} mm clear at ${point(nearest[j])}`);
  return `${found.join("; ")}.`;
}

function point(numbers) {
  return `(${numbers.map((number) => number.toFixed(1).replace("-", "−")).join(", ")})`;
}

/** The numbers of a frame in words. */
function readout(plan, j) {
  const found = [`frame ${j + 1} of ${plan.time.length}`, `${plan.time[j].toFixed(2)} s`];
  if (!plan.reached[j]) return [...found, "not reached"].join(", ");
  for (const { label, unit, values } of Object.values(plan.readout)) {
    if (values[j] !== null) found.push(`${label} ${values[j].toPrecision(3)} ${unit}`.trim());
  }
  return [...found, ...(plan.solved[j] ? [] : ["not solved"])].join(", ");
}

/** A pointer on a plot goes to the moment that it points at, and takes it along while it is held down. */
function listen(plan, place, plot) {
  const axes = place.querySelector(".axes");
  const go = (event) => {
    const box = axes.getBoundingClientRect();
    seek((((event.clientX - box.left) / box.width) * plot.end) / plan.time.at(-1));
  };
  axes.addEventListener("pointerdown", (event) => {
    axes.setPointerCapture(event.pointerId);
    go(event);
  });
  axes.addEventListener("pointermove", (event) => axes.hasPointerCapture(event.pointerId) && go(event));
}

const plots = [...document.querySelectorAll(".plots")].map((place) => [...place.querySelectorAll(".plot")]);
const told = [...document.querySelectorAll(".told")];
const arrivals = [...document.querySelectorAll(".arrival")];
views.forEach((place, k) => {
  const words = report.plans[k].coordinates.axes.map((axis) => `${axis.letters[0]} is ${axis.word}`);
  place.querySelector(".compass").setAttribute("aria-label", `Directions in ${report.plans[k].coordinates.name}: ${words.join(", ")}`);
});
report.plans.forEach((plan, k) => plan.plots.forEach((plot, p) => listen(plan, plots[k][p], plot)));
slider.addEventListener("input", () => seek(slider.value / slider.max));
button.addEventListener("click", toggle);
document.getElementById("back").addEventListener("click", () => step(-1));
document.getElementById("next").addEventListener("click", () => step(1));
document.addEventListener("keydown", onKey);
for (const control of [colouring, glass, ...document.querySelectorAll("[data-part]")]) {
  control.addEventListener("change", colour);
}
for (const choice of document.querySelectorAll("[data-camera]")) {
  choice.addEventListener("click", () => look(choice.dataset.camera));
}
document.getElementById("print").addEventListener("click", printPage);
addEventListener("beforeprint", drawShown);
const room = matchMedia("(min-width: 700px)");
const openLooks = () => (document.getElementById("looks").open = room.matches);
room.addEventListener("change", openLooks);
openLooks();
stop();
show(shown);
const graphics = document.createElement("canvas").getContext("webgl2") !== null;
requestAnimationFrame(() => setTimeout(() => report.plans.forEach((_, k) => makeScene(k, graphics))));
