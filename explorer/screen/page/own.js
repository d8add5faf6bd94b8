// The user chooses own photos, or drops files or a folder anywhere; they are sent one after the other.

import { find } from "./dom.js";

const MOST_OWN = 200; // photos of one tab
const PICTURE = /\.(jpe?g|png|webp)$/i;

/**
 * @param {{sendFile: (file: File, first: boolean) => Promise<void>}} channel
 * @param {(text: string, busy?: boolean) => void} say
 */
export const makeOwnSender = (channel, say) => {
  /** @type {File[]} */
  let queue = [];
  let taken = 0;
  /** @type {(value?: any) => void} ends the wait for the last photo */
  let answered = () => {};
  const send = async (files) => {
    const running = queue.length > 0;
    queue.push(...files.slice(0, MOST_OWN));
    if (running || !queue.length) return;
    const whole = queue;
    let unread = "";
    for (let at = 0; queue === whole && at < whole.length; at++) {
      say(whole.length > 1 ? `Reading photo ${at + 1} of ${whole.length}` : "Reading your photo", true);
      const answer = new Promise((done) => (answered = done));
      try {
        await channel.sendFile(whole[at], at === 0);
        await answer;
      } catch {
        unread = whole[at].name; // it was moved, or may not be read
      }
    }
    if (queue !== whole) return; // the connection was lost
    queue = [];
    say(unread && `${unread} cannot be read; choose it again.`, !unread);
  };

  const input = find("#file");
  input.addEventListener("change", () => {
    const files = [...input.files];
    send(input.webkitdirectory ? files.filter((file) => PICTURE.test(file.name)) : files);
    input.value = "";
  });
  const mark = (on) => document.body.classList.toggle("drop", on);
  addEventListener("dragover", (event) => {
    event.preventDefault();
    mark(true);
  });
  addEventListener("dragleave", (event) => event.relatedTarget || mark(false));
  addEventListener("drop", async (event) => {
    event.preventDefault();
    mark(false);
    const items = [...(event.dataTransfer?.items ?? [])].filter((item) => item.kind === "file");
    const entries = items.map((item) => item.webkitGetAsEntry?.() ?? item.getAsFile()); // they are gone after an await
    send((await Promise.all(entries.map((entry) => filesOf(entry, true)))).flat());
  });
  return {
    /** Choose photos, or a folder of them. */
    choose: (folder = false) => {
      input.webkitdirectory = folder;
      input.click();
    },
    /** Note how many files the server has handled. */
    received: (count) => {
      if (count > taken) answered();
      taken = count;
    },
    /** The connection is lost, and with it the server's photos. */
    lost: () => {
      [queue, taken] = [[], 0];
      answered();
    },
  };
};

/** @returns {Promise<File[]>} the file of a dropped entry, or the pictures in a folder and its folders */
const filesOf = async (entry, named = false) => {
  if (!entry) return [];
  if (entry instanceof File) return [entry];
  if (entry.isFile) return named || PICTURE.test(entry.name) ? [await new Promise((done, fail) => entry.file(done, fail))] : [];
  const reader = entry.createReader();
  const files = [];
  for (;;) {
    const some = await new Promise((done, fail) => reader.readEntries(done, fail));
    if (!some.length || files.length >= MOST_OWN) return files;
    for (const one of some) files.push(...(await filesOf(one)));
  }
};
