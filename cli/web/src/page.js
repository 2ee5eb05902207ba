"use strict";
// Puts the parts that the server sends in place, and sends the orders of the buttons.
const said = document.getElementById("said");
const field = document.getElementById("token");

// The address contains the token after the `#`, which no browser sends. Keep it for this tab only.
if (location.hash.length > 1) {
  sessionStorage.setItem("token", location.hash.slice(1));
  history.replaceState(null, "", location.pathname);
}
field.value = sessionStorage.getItem("token") ?? "";
field.addEventListener("input", () => sessionStorage.setItem("token", field.value.trim()));

const events = new EventSource("/events");
events.onmessage = (message) => {
  const { state, parts, plots: data } = JSON.parse(message.data);
  for (const [name, html] of Object.entries(parts)) {
    document.getElementById(name).innerHTML = html;
  }
  for (const [name, spec] of Object.entries(data)) {
    plots.put(document.getElementById(name), spec);
  }
  document.body.dataset.obeyed = state.obeyed ?? "";
  if (state.ended) {
    events.close();
  }
};
events.onerror = () => {
  document.getElementById("head").innerHTML = '<div class="verdict bad">no connection</div>';
};

for (const button of document.querySelectorAll("button[data-hand]")) {
  button.addEventListener("click", async () => {
    const { hand, system } = button.dataset;
    try {
      const answer = await fetch("/hands", {
        method: "POST",
        headers: { "Content-Type": "application/json", Authorization: `Bearer ${field.value.trim()}` },
        body: JSON.stringify({ hand, system }),
      });
      said.textContent = (await answer.json()).said;
    } catch (error) {
      said.textContent = `no answer: ${error.message}`;
    }
  });
}
