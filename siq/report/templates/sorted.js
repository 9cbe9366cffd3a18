/* Tables of more than two rows are sorted by the heading that is pressed, and back again. Without scripts they stay as they are. */
(function () {
  "use strict";
  const minus = text => text.replace(/\u2212/g, "-"), raised = "⁰¹²³⁴⁵⁶⁷⁸⁹";
  // The first number of a cell, its power of ten included; NaN where there is none.
  function value(text) {
    const number = minus(text).match(/-?[\d.]+(?:e[+-]?\d+)?/i), power = text.match(/10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)/);
    if (!number) return NaN;
    const digits = power ? [...power[1]].map(c => c === "⁻" ? "-" : raised.indexOf(c)).join("") : "0";
    return parseFloat(number[0]) * Math.pow(10, Number(digits));
  }
  document.querySelectorAll(".table-block table").forEach(table => {
    const body = table.tBodies[0];
    if (body.rows.length < 3) return;
    [...table.tHead.rows[0].cells].forEach((head, column) => {
      if (!head.textContent.trim()) return;  // a button would have no name to read out
      const button = document.createElement("button"), cell = row => row.cells[column].textContent;
      button.type = "button";
      button.className = "by";
      button.append(...head.childNodes);
      head.append(button);
      button.addEventListener("click", () => {
        const falling = head.getAttribute("aria-sort") === "ascending";
        for (const one of table.tHead.rows[0].cells) one.removeAttribute("aria-sort");
        head.setAttribute("aria-sort", falling ? "descending" : "ascending");
        const rows = [...body.rows], numeric = rows.every(row => !cell(row).trim() || !isNaN(value(cell(row))));
        rows.sort((one, other) => {
          const [a, b] = [cell(one).trim(), cell(other).trim()];
          if (!a || !b) return Number(!a) - Number(!b);  // what is empty comes last, both ways
          return (falling ? -1 : 1) * (numeric ? value(a) - value(b) : a.localeCompare(b));
        });
        body.append(...rows);
      });
    });
  });
}());
