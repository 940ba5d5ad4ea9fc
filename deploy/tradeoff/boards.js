"use strict";
{
  // The networks on the chosen board and configuration: rows of the table, and their places beside a chosen figure.
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];
  const QUALITY = "PSNR";
  const EVERY = "all";

  const section = document.querySelector("#boards");
  const name = (each) => each.cells[0].dataset.value;
  const make = (kind, attributes, ...children) => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", kind);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    made.append(...children);
    return made;
  };

  // 1, 2 and 5 times powers of ten within a range.
  const roundSteps = (low, high) => {
    const found = [];
    for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high); power += 1) {
      for (const digit of [1, 2, 5]) found.push(digit * 10 ** power);
    }
    return found.filter((each) => each >= low && each <= high);
  };
  const evenSteps = (low, high, count) => {
    const rough = (high - low) / count;
    const step = roundSteps(rough / 10, rough * 10).find((each) => each >= rough) ?? rough;
    const first = Math.ceil(low / step);
    return Array.from({ length: Math.floor(high / step) - first + 1 }, (_, k) => (first + k) * step);
  };
  const written = (value) => Number(value.toPrecision(3)).toLocaleString("en", { maximumSignificantDigits: 3 });
  const padded = ([low, high], share) => [low - share * (high - low || 1), high + share * (high - low || 1)];
  const range = (values) => [Math.min(...values), Math.max(...values)];

  if (section) {
    const table = section.querySelector("table");
    const rows = [...table.tBodies[0].rows];
    const chosen = Object.fromEntries(all("select", section).map((each) => [each.name, each]));
    const drawn = section.querySelector(".drawn");
    const status = section.querySelector("[role=status]");
    const head = (key) => table.tHead.querySelector(`[data-key="${key}"]`);
    const cell = (row, key) => row.cells[[...head(key).parentNode.children].indexOf(head(key))];
    const text = (row, key) => cell(row, key).dataset.value;
    const fill = (select, values) => {
      const kept = select.value;
      select.replaceChildren(...[...new Set(values)].map((each) => new Option(each)));
      if (values.includes(kept)) select.value = kept;
    };

    const point = (row, key) => {
      const { value, low, high } = cell(row, key).dataset;
      return value === "" ? null : [value, low ?? value, high ?? value].map(Number);
    };
    const draw = (shown) => {
      const key = chosen.figure.value;
      const known = shown.map((row) => ({ row, x: point(row, key), y: point(row, QUALITY) })).filter((p) => p.x && p.y);
      drawn.hidden = known.length === 0;
      if (!known.length) return;
      const width = Math.max(300, Math.min(1080, section.clientWidth));
      const [left, right, top, height] = [58, 12, 12, width < 500 ? 340 : 400];
      const bottom = height - 46;
      const xs = padded(range(known.flatMap((p) => p.x)).map(Math.log10), 0.04).map((each) => 10 ** each);
      const ys = padded(range(known.map((p) => p.y[0])), 0.2);
      const across = (value) => left + ((Math.log10(value / xs[0])) / Math.log10(xs[1] / xs[0])) * (width - left - right);
      const up = (value) => bottom - ((value - ys[0]) / (ys[1] - ys[0])) * (bottom - top);
      const line = (x1, y1, x2, y2, style) => make("line", { x1, y1, x2, y2, class: style });
      const label = (x, y, words, anchor = "middle") => make("text", { x, y, "text-anchor": anchor }, words);
      const parts = [];
      let last = -Infinity;
      for (const value of roundSteps(...xs)) {
        parts.push(line(across(value), top, across(value), bottom, "grid"));
        if (across(value) - last < 44) continue;
        last = across(value);
        parts.push(label(last, bottom + 17, written(value)));
      }
      const heights = evenSteps(...ys, 6);
      const digits = Math.max(0, Math.ceil(-Math.log10(heights[1] - heights[0]) - 1e-9));
      for (const value of heights) {
        const words = label(left - 6, up(value) + 4, value.toFixed(digits), "end");
        words.setAttribute("class", "height");
        parts.push(line(left, up(value), width - right, up(value), "grid"), words);
      }
      const title = (which) => `${which}, ${head(which).querySelector("small").textContent}`;
      parts.push(label((left + width - right) / 2, height - 8, `${title(key)} (predicted)`));
      const side = label(0, 0, `${title(QUALITY)} (measured)`);
      side.setAttribute("transform", `translate(14 ${(top + bottom) / 2}) rotate(-90)`);
      parts.push(side);
      for (const { row, x, y } of known) {
        const mark = row.querySelector(".chip").cloneNode(true);
        for (const [attribute, value] of Object.entries({ x: across(x[0]) - 9, y: up(y[0]) - 9, width: 18, height: 18 })) {
          mark.setAttribute(attribute, value);
        }
        const said = `${name(row)}\n${key} ${cell(row, key).querySelector("b").textContent} ${cell(row, key).querySelector("span")?.textContent ?? ""}`;
        const bar = line(across(x[1]), up(y[0]), across(x[2]), up(y[0]), "interval");
        bar.setAttribute("color", mark.getAttribute("color"));
        parts.push(make("g", {}, make("title", {}, said), bar, mark));
      }
      const svg = make("svg", { viewBox: `0 0 ${width} ${height}`, role: "img" }, ...parts);
      svg.setAttribute("aria-label", `${QUALITY} against ${key} on ${chosen.board.value} ${chosen.configuration.value}`);
      drawn.replaceChildren(svg);
    };

    const show = () => {
      const mine = rows.filter((row) => text(row, "board") === chosen.board.value);
      fill(chosen.configuration, [EVERY, ...mine.map((row) => text(row, "configuration"))]);
      if (chosen.board.dataset.shown !== chosen.board.value) {
        chosen.configuration.value = text(mine[0], "configuration"); // the board's own stands first
        chosen.board.dataset.shown = chosen.board.value;
      }
      const { value } = chosen.configuration;
      const shown = mine.filter((row) => value === EVERY || text(row, "configuration") === value);
      for (const row of rows) row.hidden = !shown.includes(row);
      const reasons = new Set(shown.map((row) => cell(row, chosen.figure.value)).filter((each) => !each.dataset.value)
        .map((each) => `${chosen.figure.value} of ${chosen.board.value} is unavailable: ${each.title}.`));
      status.textContent = [...reasons].join(" ");
      draw(shown);
    };
    fill(chosen.board, rows.map((row) => text(row, "board")));
    for (const each of Object.values(chosen)) each.addEventListener("change", show);
    addEventListener("resize", show);
    all(".choosers", section)[0].hidden = false;
    show();
  }
}
