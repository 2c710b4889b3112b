"use strict";
// Figures of the page: their data stand beside them as JSON, and each is drawn once.
const toile = {
  json: (id) => JSON.parse(document.getElementById(id).textContent),

  floats: (base64) => new Float32Array(Uint8Array.from(atob(base64), (c) => c.charCodeAt(0)).buffer),

  // As wide as a phone: figures that have a layout of their own for that are drawn in it.
  narrow: matchMedia("(max-width: 600px)"),

  // Called after figures were arranged anew.
  rearranged: [],

  drawFigures: () => {
    const config = { displayModeBar: false, responsive: true, showTips: false };
    const layoutOf = ({ layout }) =>
      structuredClone((toile.narrow.matches && layout.meta && layout.meta.narrow) || layout);
    const places = [...document.querySelectorAll("[data-figure]")];
    const figures = new Map(places.map((place) => [place, toile.json(place.dataset.figure)]));
    toile.narrow.addEventListener("change", async () => {
      const having = places.filter((place) => figures.get(place).layout.meta);
      await Promise.all(having.map((place) => Plotly.react(place, place.data, layoutOf(figures.get(place)), config)));
      toile.rearranged.forEach((then) => then());
    });
    return Promise.all(
      places.map((place) => Plotly.newPlot(place, figures.get(place).data, layoutOf(figures.get(place)), config)),
    );
  },
};
