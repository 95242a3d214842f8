// Numbers that are typed: with a decimal point or a decimal comma, with a minus of the keyboard or of a text.
const NUMBER = /^[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?$/i;

// the number of a text, NaN for any other text; "1.234,5" is one
export function readNumber(text) {
  const plain = text.trim().replace(/^[\u2212\u2013]/, '-').replace(',', '.');
  return NUMBER.test(plain) ? Number(plain) : NaN;
}

// marks a field whose text is no number, or none that is taken; whether it is one
export function check(input, taken) {
  if (taken) input.removeAttribute('aria-invalid'); else input.setAttribute('aria-invalid', 'true');
  return taken;
}

// arrow keys step a field as they do one of type number, which drops a comma and so reads 3,5 as 35
export function stepped(input, step, tidy = (value) => value) {
  input.addEventListener('keydown', (event) => {
    const sign = { ArrowUp: 1, ArrowDown: -1 }[event.key];
    const value = readNumber(input.value);
    if (!sign || Number.isNaN(value)) return;
    event.preventDefault();
    input.value = tidy(value + sign * step());
    input.dispatchEvent(new Event('input', { bubbles: true }));
    input.dispatchEvent(new Event('change', { bubbles: true }));
  });
}
