// Numbers as pages show them: as many decimals as show two digits of sigma, a true minus, a dash for none.
export const decimals = (sigma) => (sigma > 0 && Number.isFinite(sigma) ? Math.max(0, Math.min(9, 1 - Math.floor(Math.log10(sigma)))) : 4);

export const fixed = (value, places) => {
  if (value === undefined || value === null || !Number.isFinite(value)) return '–';
  return (Number(value.toFixed(places)) + 0).toFixed(places).replace('-', '−');
};
