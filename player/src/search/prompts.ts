// Prompts with "everything", "nothing" and exclusions, as in r5dgs_core/search/prompts.py.
import { casefold, phrases, type Phrase, spaced, wordsOf } from "./english.ts";

const MAX_LETTERS = 1000;
const THINGS = String.raw`(?:\s+(?:of\s+)?(?:the|these|those|them|it|my))?(?:\s+(?:objects?|things?|items?))?`;
const ALL = String.raw`(?:the\s+)?(?:everything|anything|all|every|each|any)${THINGS}`;
const NONE = String.raw`(?:nothing|none${THINGS}|no\s+(?:objects?|things?))`;
const EVERYTHING = new RegExp(`^(?:${ALL})$`, "i");
const NOTHING = new RegExp(`^(?:${NONE})$`, "i");
const EXCEPT = new RegExp(
  String.raw`(?:\b(?:but|and)\s+|[,;]\s*)?\bnot\b|\bexcept(?:ing)?\b(?:\s+for\b)?|\bexcluding\b|\bother\s+than\b|\bapart\s+from\b`,
  "gi",
);
const BUT = new RegExp(
  String.raw`^(?:\s*(?:${ALL}|${NONE})?\s*(?<but>\b(?:but|without|minus|besides)\b)|\s*(?:all|every|any)\b.*?(?<late>\bbut\b))`,
  "dis",
);

export class PromptError extends Error {}
export interface Prompt { wanted: Phrase[]; excluded: Phrase[]; everything: boolean }

const spelled = (name: string): string => spaced(casefold(name));
const trimmed = (text: string): string => text.replace(/^[ ,;]+|[ ,;]+$/g, "");

export function parse(text: string, names: string[]): Prompt {
  if ([...text].length > MAX_LETTERS) throw new PromptError(`expected at most ${MAX_LETTERS} letters`);
  const known = new Set(names.map(spelled));
  const found = known.has(spelled(text)) ? null : first(text);
  if (!found) return list(text, known);
  const left = trimmed(text.slice(0, found[0])), word = trimmed(text.slice(...found));
  let right = text.slice(found[1]).trim();
  if (!right) throw new PromptError(`nothing to exclude after “${word}”; name an object after it`);
  if (!known.has(spelled(right))) right = right.replace(EXCEPT, " and ");
  const excluded = list(right, known);
  if (NOTHING.test(left)) return excluded;
  if (excluded.everything) return { wanted: [], excluded: [], everything: false };
  const kept = !left || EVERYTHING.test(left) ? { wanted: [], everything: true } : list(left, known);
  return { wanted: kept.wanted, excluded: excluded.wanted, everything: kept.everything };
}

function list(text: string, names: Set<string>): Prompt {
  const words = wordsOf(text);
  if (words.length && names.has(spelled(text))) return { wanted: [[text.trim(), words]], excluded: [], everything: false };
  const prompt: Prompt = { wanted: [], excluded: [], everything: false };
  for (const [said, own] of phrases(text)) {
    const named = names.has(spelled(said));
    if (!named && EVERYTHING.test(said)) prompt.everything = true;
    else if (named || !NOTHING.test(said)) prompt.wanted.push([said, own]);
  }
  return prompt;
}

// Start and end of the first excluding word.
function first(text: string): [number, number] | null {
  EXCEPT.lastIndex = 0;
  const always = EXCEPT.exec(text), but = BUT.exec(text);
  const spans: [number, number][] = always ? [[always.index, always.index + always[0].length]] : [];
  const groups = but?.indices?.groups;
  const span = groups?.but ?? groups?.late;
  if (span) spans.push([span[0], span[1]]);
  return spans.sort((a, b) => a[0] - b[0] || a[1] - b[1])[0] ?? null;
}
