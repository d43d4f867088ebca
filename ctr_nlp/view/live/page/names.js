/** What viser leaves out: names by which screen readers tell controls, and contrast of their words. */
(() => {
  const style = document.createElement("style");
  style.textContent =
    ":root { --mantine-color-dimmed: #495057 !important; --mantine-primary-color-filled: #1864ab !important; " +
    "--mantine-primary-color-filled-hover: #145291 !important; }" +
    ".visually-hidden { position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%); }";
  document.head.append(style);

  /** Whether a control has no name of its own; its label may be one that viser points at another element. */
  const unnamed = (control) => !control.getAttribute("aria-label") && !control.labels?.length;

  function nameControls() {
    for (const label of document.querySelectorAll("label[for]")) {
      const place = document.getElementById(label.htmlFor);
      if (!place || place.matches("input")) continue;
      for (const control of place.parentElement.querySelectorAll("[role=slider], input:not([type=hidden])")) {
        if (unnamed(control)) control.setAttribute("aria-label", label.textContent);
      }
    }
    for (const button of document.querySelectorAll("button")) {
      if (button.textContent.trim() || button.getAttribute("aria-label")) continue;
      button.setAttribute("aria-label", button.closest("[role=alert]") ? "Close" : "Settings of the page");
    }
    const root = document.getElementById("root");
    root.setAttribute("role", "main");
    if (!document.querySelector("h1")) {
      const heading = document.createElement("h1");
      heading.className = "visually-hidden";
      heading.textContent = document.title;
      root.append(heading);
    }
  }

  new MutationObserver(nameControls).observe(document.body, { childList: true, subtree: true });
  nameControls();
})();
