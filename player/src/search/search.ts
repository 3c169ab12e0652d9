// Objects by words: names, aliases and stored words, ranked as by `r5dgs query` (r5dgs_core/search/object_search.py).
import { phrases, type Phrase, wordsOf } from "./english.ts";
import { parse, type Prompt, PromptError } from "./prompts.ts";
import { nearness, similarity } from "./spelling.ts";

const THRESHOLD = 0.5, SETTLED = 0.9, HEAD_WEIGHT = 0.65;

export interface Label { id: number; name: string; aliases: string[] }
export interface Match { id: number; score: number; why: string }
export type StoredWord = [string, [number, number, number][]]; // the word, and id, score and cosine of its matches
export interface Answer { matches: Match[]; note: string }

const mean = (values: number[]): number => values.reduce((sum, value) => sum + value, 0) / values.length;

export class Search {
  private readonly rows = new Map<string, StoredWord>();

  constructor(private readonly labels: Label[], words: StoredWord[]) {
    for (const stored of words) {
      const said = phrases(stored[0]);
      const key = said.length === 1 ? said[0][1].join(" ") : null;
      if (key !== null && !this.rows.has(key)) this.rows.set(key, stored);
    }
  }

  // Matches of a text, best first, and a note if something has no match.
  find(text: string): Answer {
    let prompt: Prompt;
    try {
      prompt = parse(text, this.labels.flatMap((label) => [label.name, ...label.aliases]));
    } catch (error) {
      if (error instanceof PromptError) return { matches: [], note: error.message };
      throw error;
    }
    const unknown = prompt.excluded.filter((phrase) => !this.matches([phrase]).length);
    if (unknown.length) return { matches: [], note: `excludes an unknown object: ${this.nothing(unknown[0][0])}` };
    const best = new Map<number, Match>();
    if (prompt.everything) {
      const why = prompt.excluded.length ? "all others" : "all";
      for (const { id } of this.labels) if (id > 0) best.set(id, { id, score: 1, why });
    }
    for (const match of this.matches(prompt.wanted)) {
      const other = best.get(match.id);
      if (!other || match.score > other.score) best.set(match.id, match);
    }
    for (const match of this.matches(prompt.excluded)) best.delete(match.id);
    const matches = [...best.values()].sort((a, b) => rounded(b.score) - rounded(a.score) || a.id - b.id);
    if (matches.length) {
      const missing = prompt.wanted.filter((phrase) => !this.matches([phrase]).length);
      return { matches, note: missing.map(([said]) => `nothing matches “${said}”`).join("; ") };
    }
    if (wordsOf(text).length && !prompt.wanted.length && !prompt.everything) {
      return { matches, note: `“${text.trim()}” selects no objects` };
    }
    return { matches, note: this.nothing(text) };
  }

  private matches(list: Phrase[]): Match[] {
    return list.flatMap((phrase) => this.phraseMatches(phrase)).filter((match) => match.score >= THRESHOLD);
  }

  private phraseMatches([, words]: Phrase): Match[] {
    let named = this.labels.flatMap((label) => bestMatch(label, words) ?? []);
    if (named.some((match) => match.score >= SETTLED)) return named;
    const stored = this.rows.get(words.join(" "));
    if (!stored) return named;
    const fitting = new Set(stored[1].map(([id]) => id));
    const last = words[words.length - 1];
    named = named.filter((match) => fitting.has(match.id) || endsWith(this.labels.find((one) => one.id === match.id)!, last));
    return [...named, ...stored[1].map(([id, score, cosine]) => ({
      id, score, why: `meaning of “${stored[0]}” (${cosine.toFixed(2)})`,
    }))];
  }

  private nothing(text: string): string {
    const objects = this.labels.filter((label) => label.id > 0);
    const near = objects.map((label) => {
      const names = [label.name, ...label.aliases].map((name): [number, string] => [closeness(text, name), name]);
      return { id: label.id, nearest: names.reduce((best, one) => (one[0] > best[0] ? one : best)) };
    }).filter((one) => one.nearest[0] > 0).sort((a, b) => b.nearest[0] - a.nearest[0] || a.id - b.id);
    const meant = near.slice(0, 3).map((one) => `“${one.nearest[1]}”`).join(" or ");
    const problem = `nothing matches “${text.trim()}”`;
    if (meant) return `${problem}; did you mean ${meant}?`;
    return `${problem}; the scene has: ${objects.map((label) => label.name).join(", ") || "no objects"}`;
  }
}

const rounded = (score: number): number => Math.round(score * 1e6);

function bestMatch(label: Label, asked: string[]): Match | null {
  let best: Match | null = null;
  const names: [string, string, number][] = [["name", label.name, 1]];
  for (const alias of label.aliases) names.push(["alias", alias, 0.97]);
  for (const [kind, text, weight] of names) {
    const words = wordsOf(text);
    if (!words.length) continue;
    const table = asked.map((word) => words.map((present) => similarity(word, present)));
    const whole = words.join("");
    const said = asked.map((word, row) => Math.max(...table[row], similarity(word, whole)));
    const covered = said.length === 1
      ? said[0] : HEAD_WEIGHT * said[said.length - 1] + (1 - HEAD_WEIGHT) * mean(said.slice(0, -1));
    const named = mean(words.map((_, column) => Math.max(...table.map((row) => row[column]))));
    const score = weight * covered * (0.85 + 0.15 * named);
    if (score > 0 && (!best || score > best.score)) {
      const near = Math.max(...said) === 1 ? "" : `, near “${asked.join(" ")}”`;
      best = { id: label.id, score, why: `${kind} “${text}”${near}` };
    }
  }
  return best;
}

const endsWith = (label: Label, word: string): boolean =>
  [label.name, ...label.aliases].some((name) => wordsOf(name).some((present) => present.endsWith(word)));

function closeness(text: string, name: string): number {
  const asked = phrases(text).flatMap(([, words]) => words), present = wordsOf(name);
  if (!asked.length || !present.length) return 0;
  const pairs = [...asked.flatMap((a) => present.map((b): [string, string] => [a, b])),
    [asked.join(""), present.join("")] as [string, string]];
  return Math.max(...pairs.map(([a, b]) => nearness(a, b)));
}
