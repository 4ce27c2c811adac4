// Sorts and filters the photos' thumbnails.
(function () {
  "use strict";
  const grid = document.getElementById("photos");
  const [order, kind] = ["photo-order", "photo-kind"].map((id) => document.getElementById(id));
  if (!grid || !order || !kind) return;
  document.getElementById("photo-controls").hidden = false;
  const all = [...grid.children];
  const number = (figure, key) => (figure.dataset[key] ? Number(figure.dataset[key]) : -1);
  const orders = {
    given: (a, b) => all.indexOf(a) - all.indexOf(b),
    name: (a, b) => a.dataset.name.localeCompare(b.dataset.name),
    error: (a, b) => number(b, "error") - number(a, "error"),
    points: (a, b) => number(a, "points") - number(b, "points"),
    explained: (a, b) => number(a, "explained") - number(b, "explained"),
  };
  const arrange = () => {
    grid.append(...[...all].sort(orders[order.value]));
    for (const figure of all) figure.hidden = kind.value !== "all" && figure.dataset.state !== kind.value;
  };
  order.addEventListener("change", arrange);
  kind.addEventListener("change", arrange);
})();
