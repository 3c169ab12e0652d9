// Similarity of words, as in r5dgs_core/search/spelling.py.

const TYPO_RATIO = 0.75, LETTERS_PER_SLIP = 3, MAX_SLIPS = 3;

export function similarity(word: string, present: string): number {
  if (word === present) return 1;
  const a = [...word], b = [...present];
  if (a.length >= 3 && present.startsWith(word)) return 0.75 + (0.2 * a.length) / b.length;
  if (a.length >= 3 && present.includes(word)) return 0.6 + (0.2 * a.length) / b.length;
  const shorter = Math.min(a.length, b.length), longer = Math.max(a.length, b.length);
  if (shorter < 4 || 2 * shorter < TYPO_RATIO * (shorter + longer)) return 0;
  let found = ratio(a, b);
  if ([...a].sort().join("") === [...b].sort().join("")) found = Math.max(found, 0.85);
  return found >= TYPO_RATIO ? 0.9 * found : 0;
}

// Python's difflib.SequenceMatcher(None, a, b, autojunk=False).ratio().
export function ratio(a: string[], b: string[]): number {
  const total = a.length + b.length;
  return total ? (2 * matched(a, b, 0, a.length, 0, b.length)) / total : 1;
}

function matched(a: string[], b: string[], aLow: number, aHigh: number, bLow: number, bHigh: number): number {
  let bestA = aLow, bestB = bLow, size = 0;
  let before = new Map<number, number>();
  for (let i = aLow; i < aHigh; i++) {
    const now = new Map<number, number>();
    for (let j = bLow; j < bHigh; j++) {
      if (a[i] !== b[j]) continue;
      const k = (before.get(j - 1) ?? 0) + 1;
      now.set(j, k);
      if (k > size) [bestA, bestB, size] = [i - k + 1, j - k + 1, k];
    }
    before = now;
  }
  if (!size) return 0;
  return size + matched(a, b, aLow, bestA, bLow, bestB) + matched(a, b, bestA + size, aHigh, bestB + size, bHigh);
}

export function nearness(word: string, other: string): number {
  const a = [...word], b = [...other];
  const shorter = Math.min(a.length, b.length), longer = Math.max(a.length, b.length);
  const excused = Math.min(Math.floor(shorter / LETTERS_PER_SLIP), MAX_SLIPS);
  if (longer - shorter > excused) return 0;
  const slips = editDistance(a, b);
  return slips <= excused ? 1 - slips / longer : 0;
}

// Damerau-Levenshtein distance, with transpositions of neighbours.
function editDistance(a: string[], b: string[]): number {
  const rows: number[][] = [Array.from({ length: b.length + 1 }, (_, j) => j)];
  a.forEach((letter, i) => {
    const row = [i + 1], last = rows[i], before = rows[i - 1];
    b.forEach((other, j) => {
      let best = Math.min(row[j] + 1, last[j + 1] + 1, last[j] + Number(letter !== other));
      if (i > 0 && j > 0 && letter === b[j - 1] && a[i - 1] === other) best = Math.min(best, before[j - 1] + 1);
      row.push(best);
    });
    rows.push(row);
  });
  return rows[a.length][b.length];
}
