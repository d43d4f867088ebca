"use strict";

const report = JSON.parse(document.getElementById("data").textContent);
const slider = document.getElementById("frame");
const button = document.getElementById("play");
const colouring = document.getElementById("colouring");
const glass = document.getElementById("glass");
const drawn = document.getElementById("drawn");
const sections = [...document.querySelectorAll(".plan")];
const duration = Math.max(...report.plans.map((plan) => plan.time.at(-1)));
const scenes = report.plans.map(() => null);
let playing = null;
let view = "";

/** Index and time of the frame of a plan at a part in (0, 1] of its own time. */
function frameAt(plan, part) {
  return Math.max(0, Math.min(plan.time.length, Math.round(part * plan.time.length)) - 1);
}

/** Show all plans at a part of their time; between frames where the robot is on its way from one to the next. */
function show(part) {
  report.plans.forEach((plan, k) => {
    const j = frameAt(plan, part);
    const exact = Math.max(0, Math.min(part * plan.time.length - 1, plan.time.length - 1));
    const between = playing && plan.reached[Math.floor(exact)] && plan.reached[Math.ceil(exact)];
    if (scenes[k]) scenes[k].setTime(between ? exact : j);
    for (const id of plan.cursors) {
      for (const shown of Bokeh.documents) {
        const cursor = shown.get_model_by_id(id);
        if (cursor) cursor.location = plan.time[j];
      }
    }
    sections[k].querySelector(".readout").textContent = readout(plan, j);
  });
  slider.value = Math.max(1, Math.round(part * slider.max));
  document.getElementById("moment").textContent = `frame ${slider.value} of ${slider.max}`;
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

/** Stop playing, and show a part of the time. */
function seek(part) {
  stop();
  show(Math.max(0, Math.min(1, part)));
}

function play() {
  let part = slider.value >= slider.max * 1 ? 0 : slider.value / slider.max;
  let before = performance.now();
  button.innerHTML = "&#10074;&#10074;";
  button.setAttribute("aria-label", "Pause");
  const step = (now) => {
    part += (now - before) / 1000 / duration;
    before = now;
    if (part >= 1) return seek(1);
    playing = requestAnimationFrame(step);
    show(part);
  };
  playing = requestAnimationFrame(step);
}

function stop() {
  cancelAnimationFrame(playing);
  playing = null;
  button.innerHTML = "&#9654;";
  button.setAttribute("aria-label", "Play");
}

/**
 * Colour what plans know by the chosen quantity, and other plans by tube; let the target, and drawn robots, which
 * lie close to the plan, be seen through tubes.
 */
function colour() {
  const key = colouring.value;
  for (const legend of document.querySelectorAll(".legend[data-key]")) legend.hidden = legend.dataset.key !== key;
  for (const legend of document.querySelectorAll(".legend.drawn")) legend.hidden = !drawn.checked;
  report.plans.forEach((plan, k) => {
    if (!scenes[k]) return;
    const shown = plan.colourings.includes(key) ? key : plan.colourings[0];
    for (const object of Object.values(scenes[k].getWorld().ObjectsListJson)) {
      if (!object.custom_data) continue;
      if (object.custom_data.drawn) {
        object.visible = drawn.checked;
        continue;
      }
      object.visible = object.custom_data.colouring === shown;
      object.opacity = glass.checked || drawn?.checked ? 0.4 : 1;
    }
  });
  show(slider.value / slider.max);
}

/** Called by each scene once it is drawn; all cameras move as one. */
function ready(frame, scene) {
  const k = sections.findIndex((section) => section.contains(frame));
  scenes[k] = scene;
  scene.on(scene.events.CAMERA_CHANGE, (camera) => {
    const seen = camera.map((number) => number.toFixed(3)).join();
    if (seen === view) return;
    view = seen;
    scenes.forEach((other) => other && other !== scene && other.setCamera(camera));
  });
  colour();
}

const graphics = document.createElement("canvas").getContext("webgl2") !== null;
report.plans.forEach((plan, k) => {
  const place = sections[k].querySelector(".scene");
  if (graphics) {
    const frame = document.createElement("iframe");
    frame.srcdoc = report.template.replace(report.placeholder, () => plan.scene);
    place.append(frame);
  } else {
    place.innerHTML =
      "<p class='missing'>The robot cannot be shown: this browser has no WebGL 2, or it is switched off. " +
      "Plots and numbers work without it.</p>";
  }
});

slider.addEventListener("input", () => seek(slider.value / slider.max));
button.addEventListener("click", () => (playing ? stop() : play()));
colouring.addEventListener("change", colour);
glass.addEventListener("change", colour);
if (drawn) drawn.addEventListener("change", colour);
show(1 / slider.max);
