// Filters of the list of episodes. Without scripts the page shows everything, and this bar stays away.
const bar = document.querySelector(".filters");
const episodes = [...document.querySelectorAll("article")];
const words = bar.querySelector("input");
let state = "";
const apply = () => {
  const wanted = words.value.trim().toLowerCase();
  for (const episode of episodes) {
    const text = episode.textContent.toLowerCase();
    episode.hidden = Boolean(state && !episode.classList.contains(state)) || !text.includes(wanted);
  }
  const shown = episodes.filter((episode) => !episode.hidden).length;
  bar.querySelector("output").textContent = `${shown} of ${episodes.length} shown`;
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
  if (target) target.hidden = false;
});
bar.hidden = false;
apply();
