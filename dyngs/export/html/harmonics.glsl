// The real spherical harmonics of degrees 1 to DEGREE.
// What harmonics beyond the constant add to colour i, seen along d.
vec3 harmonics(int i, vec3 d) {
  vec3 color = vec3(0.0);
#if DEGREE > 0
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  float basis[(DEGREE + 1) * (DEGREE + 1) - 1];
  basis[0] = -0.4886025119029199 * y;
  basis[1] = 0.4886025119029199 * z;
  basis[2] = -0.4886025119029199 * x;
#if DEGREE > 1
  basis[3] = 1.0925484305920792 * x * y;
  basis[4] = -1.0925484305920792 * y * z;
  basis[5] = 0.31539156525252005 * (2.0 * zz - xx - yy);
  basis[6] = -1.0925484305920792 * x * z;
  basis[7] = 0.5462742152960396 * (xx - yy);
#endif
#if DEGREE > 2
  basis[8] = -0.5900435899266435 * y * (3.0 * xx - yy);
  basis[9] = 2.890611442640554 * x * y * z;
  basis[10] = -0.4570457994644658 * y * (4.0 * zz - xx - yy);
  basis[11] = 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
  basis[12] = -0.4570457994644658 * x * (4.0 * zz - xx - yy);
  basis[13] = 1.445305721320277 * z * (xx - yy);
  basis[14] = -0.5900435899266435 * x * (xx - 3.0 * yy);
#endif
#if DEGREE > 3
  basis[15] = 2.5033429417967046 * x * y * (xx - yy);
  basis[16] = -1.7701307697799304 * y * z * (3.0 * xx - yy);
  basis[17] = 0.9461746957575601 * x * y * (7.0 * zz - 1.0);
  basis[18] = -0.6690465435572892 * y * z * (7.0 * zz - 3.0);
  basis[19] = 0.10578554691520431 * (zz * (35.0 * zz - 30.0) + 3.0);
  basis[20] = -0.6690465435572892 * x * z * (7.0 * zz - 3.0);
  basis[21] = 0.47308734787878004 * (xx - yy) * (7.0 * zz - 1.0);
  basis[22] = -1.7701307697799304 * x * z * (xx - 3.0 * yy);
  basis[23] = 0.6258357354491761 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy));
#endif
  const int COUNT = (DEGREE + 1) * (DEGREE + 1) - 1;
  float values[4 * HARMONIC_TEXELS];
  for (int t = 0; t < HARMONIC_TEXELS; ++t) {
    vec4 texel = at(uHarmonics, HARMONIC_TEXELS * i + t);
    for (int k = 0; k < 4; ++k) values[4 * t + k] = texel[k];
  }
#if WAVE_TEXELS
  if (i < LINES) for (int k = 0; k < 3 * COUNT; ++k) values[k] += waves[3 + k];
#endif
  for (int k = 0; k < COUNT; ++k) color += basis[k] * vec3(values[3 * k], values[3 * k + 1], values[3 * k + 2]);
#endif
  return color;
}
