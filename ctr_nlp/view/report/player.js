/** The moment that is shown: by the slider, by playing, by keys and by plots. A moment is a part in [0, 1]. */

const duration = Math.max(...report.plans.map((plan) => plan.time.at(-1)));
const NATIVE = {
  space: "button, input[type=checkbox], select, summary, a",
  arrows: "input[type=range], select",
};
let playing = null;
let shown = 1; // the page opens with the robots as far out as they come; playing begins with the first frame

/** Place of a moment among the frames of a plan, between two of them where it is between their times. */
function placeOf(plan, part) {
  return Math.max(0, Math.min(part * plan.time.length - 1, plan.time.length - 1));
}

/** Show all plans at a moment; between frames where the robot is on its way from one to the next. */
function show(part) {
  shown = part;
  report.plans.forEach((plan, k) => {
    const exact = placeOf(plan, part);
    const between = playing && plan.reached[Math.floor(exact)] && plan.reached[Math.ceil(exact)];
    showPlan(plan, k, Math.round(exact), between ? exact : Math.round(exact));
  });
  slider.value = Math.max(1, Math.round(part * slider.max));
  document.getElementById("moment").textContent = `frame ${slider.value} of ${slider.max}`;
}

/** Stop playing, and show a moment. */
function seek(part) {
  stop();
  show(Math.max(1 / slider.max, Math.min(1, part)));
}

/** Stop playing, and go some frames on, or back. */
function step(frames) {
  seek((Number(slider.value) + frames) / slider.max);
}

function play() {
  let part = shown >= 1 ? 0 : shown;
  let before = performance.now();
  tell("Pause");
  const go = (now) => {
    part += ((now - before) / 1000 / duration) * Number(speed.value);
    before = now;
    if (part >= 1 && !loop.checked) return seek(1);
    playing = requestAnimationFrame(go);
    show(part % 1);
  };
  playing = requestAnimationFrame(go);
}

function stop() {
  cancelAnimationFrame(playing);
  playing = null;
  tell("Play");
}

function tell(action) {
  button.setAttribute("aria-label", action);
  button.dataset.action = action;
}

function toggle() {
  return playing ? stop() : play();
}

const KEYS = {
  " ": toggle,
  ArrowLeft: () => step(-1),
  ArrowRight: () => step(1),
  Home: () => seek(0),
  End: () => seek(1),
};
const TURNS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

/** Keys play, go to frames and, with shift, turn the view, except where the focused control needs them itself. */
function onKey(event) {
  if ((event.ctrlKey || event.metaKey) && event.key === "p") {
    event.preventDefault();
    return void printPage();
  }
  if (event.key === "Escape") document.activeElement.blur();
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.target.closest?.(NATIVE[event.key === " " ? "space" : "arrows"])) return;
  const turning = event.shiftKey && TURNS[event.key];
  const action = turning ? () => turn(...turning) : KEYS[event.key];
  if (!action) return;
  event.preventDefault();
  action();
}
