"use strict";
{
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];

  // Sort a table by the column of the header that is pressed; what is unavailable stays last.
  const sort = (table, header) => {
    const column = [...header.parentNode.children].indexOf(header);
    const falls = header.getAttribute("aria-sort") === "ascending";
    const body = table.tBodies[0];
    const key = (row) => row.cells[column].dataset.value;
    const compare = (a, b) =>
      header.dataset.kind === "number" ? a - b : a.localeCompare(b, "en", { numeric: true });
    const rows = [...body.rows].sort((one, other) => {
      const [a, b] = [key(one), key(other)];
      if (a === "" || b === "") return (a === "") - (b === "");
      return falls ? compare(b, a) : compare(a, b);
    });
    for (const each of header.parentNode.children) each.setAttribute("aria-sort", "none");
    header.setAttribute("aria-sort", falls ? "descending" : "ascending");
    body.append(...rows);
  };
  for (const table of all("table.sorts")) {
    for (const header of all("thead th", table)) {
      const button = document.createElement("button");
      button.type = "button";
      button.append(...header.childNodes);
      button.addEventListener("click", () => sort(table, header));
      header.append(button);
      header.setAttribute("aria-sort", "none");
    }
  }

  // Show the plot of the pressed cost and quality.
  const choice = document.querySelector("#axes");
  const pressed = (group) => choice.querySelector(`[data-${group}][aria-pressed=true]`).dataset[group];
  const show = () => {
    for (const plot of all(".front-of")) {
      plot.hidden = plot.dataset.cost !== pressed("cost") || plot.dataset.quality !== pressed("quality");
    }
  };
  if (choice) {
    for (const button of all("button", choice)) {
      button.addEventListener("click", () => {
        for (const each of all("button", button.parentNode)) each.setAttribute("aria-pressed", each === button);
        show();
      });
    }
    choice.hidden = false;
  }

  // Wipe between two crops: with the slider, its keys, or a finger on the picture.
  const wipe = document.querySelector("#wipe");
  if (wipe) {
    const slider = wipe.querySelector("input");
    const stage = wipe.querySelector(".stage");
    const [before, after] = all("img", stage);
    const [left, right] = all("select", wipe);
    const draw = () => {
      for (const [picture, chosen] of [[before, left], [after, right]]) {
        const crop = document.getElementById(chosen.value);
        picture.src = crop.src;
        picture.alt = crop.alt;
      }
      stage.style.setProperty("--cut", `${slider.value}%`);
      slider.setAttribute("aria-valuetext", `${slider.value} % ${before.alt}, the rest ${after.alt}`);
    };
    const follow = (event) => {
      if (event.type === "pointermove" && event.buttons !== 1) return;
      const box = stage.getBoundingClientRect();
      slider.value = Math.round((100 * (event.clientX - box.left)) / box.width);
      draw();
    };
    for (const type of ["pointerdown", "pointermove"]) stage.addEventListener(type, follow);
    for (const chooser of [left, right]) chooser.addEventListener("change", draw);
    slider.addEventListener("input", draw);
    wipe.hidden = false;
    draw();
  }
}
