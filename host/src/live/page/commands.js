// Buttons that tell the robot something.

import { toast } from "./status.js";

const element = (id) => document.getElementById(id);

/** What is asked before. */
const QUESTIONS = {
  forget: {
    title: "Forget the map?",
    text: "Walls, places and loops are gone for good, and a new map begins where the robot stands. Save the map first if it is of use.",
    yes: "Forget the map",
  },
  restart: {
    title: "Restart?",
    text: { robot: "The robot boots. It takes up its map again.", log: "The log begins again at its first scan, with an empty map." },
    yes: "Restart",
  },
};

export function watchCommands(model, link, tools) {
  const buttons = new Map([...document.querySelectorAll("[data-command]")].map((button) => [button.dataset.command, button]));
  const give = async (command) => {
    const { done, words } = await link.order(command);
    toast(words, done ? "info" : "warning");
  };
  const freeze = buttons.get("freeze");
  model.addEventListener("status", () => {
    const mapping = model.now.status?.mapping ?? true;
    freeze.textContent = mapping ? "Freeze map" : "Let map learn";
    freeze.setAttribute("aria-pressed", String(!mapping));
  });
  for (const [name, button] of buttons) {
    button.addEventListener("click", async () => {
      if (name === "set_pose") {
        delete document.body.dataset.panel;
        tools.setPose((pose) => give({ set_pose: { pose } }));
        return;
      }
      const question = QUESTIONS[name];
      if (question && !(await confirmed(question, model.about?.kind))) return;
      const mapping = model.now.status?.mapping ?? true;
      button.disabled = true;
      await give(name === "freeze" && !mapping ? "unfreeze" : name);
      button.disabled = false;
    });
  }
}

function confirmed({ title, text, yes }, kind) {
  const dialog = element("confirm");
  dialog.querySelector("h2").textContent = title;
  dialog.querySelector("p").textContent = typeof text === "string" ? text : text[kind === "robot" ? "robot" : "log"];
  dialog.querySelector("[value=yes]").textContent = yes;
  dialog.returnValue = "";
  dialog.showModal();
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => resolve(dialog.returnValue === "yes"), { once: true });
  });
}
