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
  sections[k].querySelector(".readout").textContent = readout(plan, frame);
}

/** Move a plot's cursor to a frame, and tell its values there. */
function mark(place, plot, time, frame) {
  place.querySelector(".cursor").style.left = `${(100 * time) / plot.end}%`;
  place.querySelectorAll("output").forEach((output, i) => {
    const value = plot.lines[i][frame];
    output.textContent = value === null ? "–" : NUMBER.format(value).replace("-", "−");
  });
}

/** The numbers of a frame in words. */
function readout(plan, j) {
  const told = [`frame ${j + 1} of ${plan.time.length}`, `${plan.time[j].toFixed(2)} s`];
  if (!plan.reached[j]) return [...told, "not reached"].join(", ");
  for (const [name, { unit, values }] of Object.entries(plan.readout)) {
    if (values[j] !== null) told.push(`${name} ${values[j].toPrecision(3)} ${unit}`.trim());
  }
  return [...told, ...(plan.solved[j] ? [] : ["not solved"])].join(", ");
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

const plots = sections.map((section) => [...section.querySelectorAll(".plot")]);
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
addEventListener("beforeprint", picture);
document.getElementById("looks").open = matchMedia("(min-width: 700px)").matches;
stop();
show(shown);
const graphics = document.createElement("canvas").getContext("webgl2") !== null;
requestAnimationFrame(() => setTimeout(() => report.plans.forEach((_, k) => makeScene(k, graphics))));
