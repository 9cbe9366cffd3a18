/* Mean times under the noise that the slider stands at. Every row stands in the page; nothing is computed here. */
(function () {
  "use strict";
  const root = document.currentScript.closest(".times-of-wells");
  const data = JSON.parse(root.querySelector("script[type='application/json']").textContent);
  const slider = root.querySelector("input");
  function show() {
    const row = data.rows[slider.value], said = data.noises[slider.value];
    root.querySelector("output").textContent = said;
    slider.setAttribute("aria-valuetext", said);
    for (const part of ["ratio", "time"]) root.querySelectorAll("[data-part='" + part + "']").forEach((cell, well) => {
      cell.textContent = row[well][part] || "–";
    });
  }
  slider.addEventListener("input", show);
  slider.closest("label").hidden = false;
  show();
}());
