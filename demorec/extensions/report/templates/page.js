// Filters of the list of episodes. Without scripts the page shows everything, and this bar stays away.
const bar = document.querySelector(".filters");
if (bar) {
  const episodes = [...document.querySelectorAll("article")];
  const words = bar.querySelector("input");
  const count = bar.querySelector("output");
  let state = "";
  const apply = () => {
    const wanted = words.value.trim().toLowerCase();
    let shown = 0;
    for (const episode of episodes) {
      const fits = (!state || episode.classList.contains(state)) && episode.dataset.words.includes(wanted);
      episode.hidden = !fits;
      shown += fits;
    }
    count.textContent = `${shown} of ${episodes.length} shown`;
  };
  bar.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    state = button.value;
    for (const other of bar.querySelectorAll("button")) other.setAttribute("aria-pressed", String(other === button));
    apply();
  });
  words.addEventListener("input", apply);
  // A link to an episode that a filter hides shows it.
  addEventListener("hashchange", () => {
    const target = document.getElementById(location.hash.slice(1));
    if (target && target.hidden) {
      target.hidden = false;
      target.scrollIntoView();
    }
  });
  bar.hidden = false;
  apply();
}
